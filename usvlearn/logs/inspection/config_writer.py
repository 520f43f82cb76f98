"""The configuration that `usvlearn inspect` writes: complete, commented, and read back before it is kept."""

from __future__ import annotations

import dataclasses
import importlib
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml

from usvlearn.core.unconfirmed import SECTION
from usvlearn.errors import printable
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.inspection.decision import UNSURE, Decision
from usvlearn.logs.read import read_recordings

MASS = 36.0  # kg, of configs/data/csv.yaml
UNITS = {"mass": ["kg, added mass included"], "surge_max": ["m/s, top speed"]}
KEYS = {"series": "name", "unit": "unit", "zero": "zero", "span": "span", "sign": "span", "messages": "held",
        "period": "period", "delay": "delay"}  # fmt: skip
PLAIN = re.compile(r"[\w/.:-]+", re.ASCII)  # what Hydra takes without quotes
SPECIAL = set('"$`\\!')  # to a shell, within double quotes


def settings_of(path: str, boat: str, reader: Any, channels: Mapping[str, Mapping], surge_max: float) -> dict[str, Any]:
    """The configuration as plain data."""
    kind, how = type(reader), {"_target_": "usvlearn.logs.read.read_recordings", "_convert_": "all"}
    options = {each.name: x for each in dataclasses.fields(reader) if (x := getattr(reader, each.name)) != each.default}
    place = {"path": path, "boat": boat, "reader": {"_target_": f"{kind.__module__}.{kind.__name__}", **options}}
    data = {**how, **place, "channels": {name: dict(source) for name, source in channels.items()}}
    return {"vehicle": {"mass": MASS, "surge_max": surge_max}, "data": data}


def read_settings(settings: Mapping[str, Any]) -> list[Recording]:
    """The recordings that a configuration reads."""
    data = settings["data"]
    module, _, kind = data["reader"]["_target_"].rpartition(".")
    options = {key: value for key, value in data["reader"].items() if key != "_target_"}
    reader = getattr(importlib.import_module(module), kind)(**options)
    return read_recordings(data["path"], reader, data["channels"], data["boat"])


def path_of(decision: Decision) -> str:
    """The setting that it decides, such as `data.channels.surge.unit`."""
    channel, what = decision.channel, KEYS.get(decision.what, decision.what)
    sections = {"vehicle": "vehicle", "reader": "data.reader", "boat": "data"}
    return f"{sections.get(channel, f'data.channels.{channel}')}.{what}"


def scalar(value: Any) -> str:
    """A value as YAML in one line, quoted where it must be."""
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf).strip()
    return text.removesuffix("...").strip()


def write_text(
    settings: Mapping[str, Any], decisions: Sequence[Decision], head: Sequence[str], ask: str, findings: Sequence[str]
) -> str:
    """The file: settings with the open questions, and beside the keys what was decided.

    `head` are lines above all keys, `ask` is what is said of the questions, `findings` are the data check's sentences.
    """
    reasons = {path_of(each): each for each in reversed(decisions)}
    lines = ["# @package _global_", *(f"# {_plain(each)}" for each in head)]
    lines += _lines({key: each for key, each in settings.items() if key != SECTION}, (), reasons)
    if settings[SECTION]:
        lines.append(f"{SECTION}:  # {_plain(ask)}")
        lines += [f"  {scalar(key)}: {scalar(each)}" for key, each in settings[SECTION].items()]
    if findings:
        lines += ["# The data check says:", *(f"#   {_plain(each)}" for each in findings)]
    return "\n".join(lines) + "\n"


def _lines(node: Mapping[str, Any], above: tuple[str, ...], reasons: Mapping[str, Decision]) -> Iterator[str]:
    """Each key with its value, what is told of it, and what else it may be."""
    space = "  " * len(above)
    for key, value in node.items():
        path = (*above, key)
        why = reasons.get(".".join(path))
        if isinstance(value, Mapping):
            yield f"{space}{key}:"
            yield from _lines(value, path, reasons)
            continue
        comments = [*UNITS.get(key, ()), *([f"{why.certainty}: {why.reason}"] if why else [])]
        yield f"{space}{key}: {scalar(value)}" + (f"  # {_plain('; '.join(comments))}" if comments else "")
        for other in why.alternatives if why and why.certainty == UNSURE else ():
            yield f"{space}# or {key}: {_plain(other)}"


def _plain(text: str) -> str:
    """One line of a comment."""
    return printable(" ".join(text.split()))


def hydra_text(value: str) -> str:
    r"""A value of an override, quoted if need be."""
    if PLAIN.fullmatch(value):
        return value
    return "'{}'".format(re.sub(r"(\\*)'", r"\1\1\\'", value))  # Hydra halves backslashes before a quote only


def shell_override(path: str) -> str:
    """`data=PATH` for a command line."""
    text = f"data={hydra_text(path)}"
    return f'"{text}"' if "'" in text and not SPECIAL & set(text) else shlex.quote(text)
