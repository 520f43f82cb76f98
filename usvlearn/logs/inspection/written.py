"""The configuration that `usvlearn inspect` writes: complete, commented, and read back before it is kept."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from usvlearn.errors import printable
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.inspection.decision import UNSURE, Decision
from usvlearn.logs.read import read_recordings

MASS = 36.0  # kg, of configs/data/csv.yaml
KEYS = {"series": "name", "unit": "unit", "zero": "zero", "span": "span", "sign": "span", "posting": "held",
        "period": "period", "delay": "delay"}  # fmt: skip


def settings_of(path: str, boat: str, reader: Any, channels: Mapping[str, Mapping], surge_max: float) -> dict[str, Any]:
    """The configuration as plain data."""
    kind = type(reader)
    options = {}
    for field in dataclasses.fields(reader):
        value = getattr(reader, field.name)
        if field.default is dataclasses.MISSING or value != field.default:
            options[field.name] = value
    return {
        "vehicle": {"mass": MASS, "surge_max": surge_max},
        "data": {
            "_target_": "usvlearn.logs.read.read_recordings",
            "_convert_": "all",
            "path": path,
            "boat": boat,
            "reader": {"_target_": f"{kind.__module__}.{kind.__name__}", **options},
            "channels": {name: dict(source) for name, source in channels.items()},
        },
    }


def read_settings(settings: Mapping[str, Any]) -> list[Recording]:
    """The recordings that a configuration reads."""
    data = settings["data"]
    module, _, kind = data["reader"]["_target_"].rpartition(".")
    options = {key: value for key, value in data["reader"].items() if key != "_target_"}
    reader = getattr(importlib.import_module(module), kind)(**options)
    return read_recordings(data["path"], reader, data["channels"], data["boat"])


def scalar(value: Any) -> str:
    """A value as YAML in one line, quoted where it must be.

    >>> scalar("no"), scalar("Schub: links"), scalar([1.0, "a"]), scalar(True), scalar("speed")
    ("'no'", "'Schub: links'", '[1.0, a]', 'true', 'speed')
    """
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf).strip()
    return text.removesuffix("...").strip()


def write_text(
    settings: Mapping[str, Any], decisions: Sequence[Decision], head: Sequence[str], findings: Sequence[str] = ()
) -> str:
    """The file.

    Args:
        settings: of `settings_of`.
        decisions: what is told beside the keys.
        head: lines above all keys.
        findings: of the data check, as sentences.
    """
    vehicle, data = settings["vehicle"], settings["data"]
    reasons = {(each.channel, KEYS.get(each.what, each.what)): each for each in reversed(decisions)}
    top = reasons.get(("vehicle", "surge_max"))
    lines = ["# @package _global_", *(f"# {_plain(each)}" for each in head), "vehicle:"]
    lines.append(
        f"  mass: {vehicle['mass']:g}  # kg, added mass included; unsure: not in the logs; the parameters scale with it"
    )
    lines.append(f"  surge_max: {vehicle['surge_max']:g}  # m/s, top speed" + (f"; {_comment(top)}" if top else ""))
    lines += ["data:", *(f"  {key}: {scalar(data[key])}" for key in ("_target_", "_convert_", "path", "boat"))]
    lines += ["  reader:", *(f"    {key}: {scalar(value)}" for key, value in data["reader"].items()), "  channels:"]
    for name, source in data["channels"].items():
        lines.append(f"    {name}:")
        for key, value in source.items():
            sentence = reasons.get((name, key))
            lines.append(f"      {key}: {scalar(value)}" + (f"  # {_comment(sentence)}" if sentence else ""))
            if sentence and sentence.certainty == UNSURE:
                lines += [f"      # or {key}: {_plain(other)}" for other in sentence.alternatives]
    if unsure := [each for each in decisions if each.certainty == UNSURE]:
        lines.append("# Unsure, please check:")
        lines += [f"#   {_plain(f'{each.channel}, {each.what}: {each.value} ({each.reason})')}" for each in unsure]
    if findings:
        lines += ["# The data check says:", *(f"#   {_plain(each)}" for each in findings)]
    return "\n".join(lines) + "\n"


def _comment(sentence: Decision) -> str:
    return _plain(f"{sentence.certainty}: {sentence.reason}")


def _plain(text: str) -> str:
    """One line of a comment."""
    return printable(" ".join(text.split()))
