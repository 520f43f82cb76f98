"""The open questions of what `usvlearn inspect` has decided, and their confirmation in the file that it wrote.

Asked is what is unsure, and what is probable if the numbers depend on it. Not asked are probable details of how
messages are used, since the data check tells where these are wrong, and what is computed from other channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.safe_yaml import read_yaml
from usvlearn.core.unconfirmed import ALL, SECTION, Questions, at, questions_in, unconfirmed
from usvlearn.errors import ConfigError, did_you_mean, printable
from usvlearn.logs.channels.channel import COMMANDS
from usvlearn.logs.inspection.config_writer import path_of, scalar
from usvlearn.logs.inspection.decision import CERTAIN, UNSURE, Decision, least

DETAILS = ("messages", "period", "window", "rejected")


def key_of(decision: Decision) -> str:
    """The name of its question: in words of the screen, and short, since a person types it."""
    channel, what = decision.channel, decision.what
    if channel in COMMANDS:
        return "sides" if what == "series" else what
    if channel in ("vehicle", "reader"):
        return what
    return channel if what == "series" else f"{channel}.{what}"


def is_question(decision: Decision, settings: Mapping[str, Any]) -> bool:
    """Whether a person should confirm it."""
    computed = decision.what == "series" and at(settings, path_of(decision)) is None
    minor = computed or decision.what in DETAILS
    return decision.certainty == UNSURE or (decision.certainty != CERTAIN and not minor)


def questions(decisions: Sequence[Decision], settings: Mapping[str, Any]) -> Questions:
    """The section of the configuration, the unsure ones first; both commands have one question in common."""
    asked: dict[str, list[Decision]] = {}
    for each in decisions:
        if is_question(each, settings):
            asked.setdefault(key_of(each), []).append(each)
    entries = {
        key: {
            "certainty": least(*(each.certainty for each in same)),
            "found": _found(same),
            "why": printable("; ".join(dict.fromkeys(" ".join(each.reason.split()) for each in same))),
            "written": {path: at(settings, path) for path in map(path_of, same)},
        }
        for key, same in asked.items()
    }
    return dict(sorted(entries.items(), key=lambda item: item[1]["certainty"] != UNSURE))


def _found(same: Sequence[Decision]) -> str:
    """What was found and what else it may be, of each side where they differ."""
    texts = [" or ".join(dict.fromkeys([each.value, *each.alternatives])) for each in same]
    sides = [f"{each.channel.removeprefix('command_')} {text}" for each, text in zip(same, texts, strict=True)]
    return printable(texts[0] if len(set(texts)) == 1 else "; ".join(sides))


def confirm(files: Sequence[str], given: Sequence[str]) -> Iterator[str]:
    """Remove questions, by one key or several, from a file that `usvlearn inspect` wrote; yields what is said.

    A ConfigError if there is no such file or question, or it does not stand in its own line.
    """
    if len(files) > 1 or not files[0].endswith((".yaml", ".yml")):
        raise ConfigError(f"--confirm: found {', '.join(files)}, expected the one file that usvlearn inspect wrote")
    content = read_yaml("--confirm", path := Path(files[0]).expanduser())
    known = questions_in(content, path)
    keys = [key.strip() for each in given for key in each.split(",")]
    if not known:
        raise ConfigError(f"--confirm: found no open question in {path}: all are confirmed, or nothing was guessed")
    for key in keys:
        if key not in (*known, ALL):
            there = f"expected one of {', '.join(dict.fromkeys([*known, ALL]))}{did_you_mean(key, known)}"
            there = f"expected {ALL}, since it has no questions. {known[ALL]['why']}" if ALL in known else there
            raise ConfigError(f"--confirm: found {key!r}, {there}")
    remaining = {} if ALL in keys else {key: each for key, each in known.items() if key not in keys}
    wanted = {**content, SECTION: {key: content[SECTION][key] for key in remaining}}
    lines = path.read_bytes().decode().rstrip("\n").split("\n")
    first = last = next((k for k, each in enumerate(lines) if each.startswith(f"{SECTION}:")), len(lines))
    while last + 1 < len(lines) and lines[last + 1].startswith(" "):
        last += 1
    gone = tuple(f"{scalar(key)}:" for key in known if key not in remaining)
    open_lines = [each for each in lines[first + 1 : last + 1] if not each.strip().startswith(gone)]
    lines[first : last + 1] = [lines[first], *open_lines] if remaining else [f"{SECTION}: {{}}"]
    if yaml.safe_load(text := "\n".join([*lines, ""])) != wanted:
        raise ConfigError(f"--confirm: {path}: found no line of its own for each question: remove them by hand")
    mode = path.stat().st_mode
    write_atomically(path.resolve(), text.encode())
    path.chmod(mode)
    yield f"Confirmed in {path}: {', '.join(keys)}."
    yield from unconfirmed(remaining) or ["Nothing is open any more."]
