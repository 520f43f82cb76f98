"""Guesses of `usvlearn inspect` that nobody has confirmed: the open questions of a configuration, in sentences.

Its section `unconfirmed` has them by key: `delay: {certainty: unsure, found: 0 s, why: …, written: {SETTING: VALUE}}`.
A question is open as long as a setting under `written` has this value and is not given on the command line.
`usvlearn inspect --confirm KEY FILE` removes it. Without the section, nothing is open, unless an older `inspect` wrote
the file, which asked nothing.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.errors import ConfigError, printable

SECTION, ALL = "unconfirmed", "all"
WRITTEN = "written by usvlearn inspect"  # in a comment above all keys
OLDER = "An older version of usvlearn inspect wrote this file and asked nothing: run it again."
PROBABLE, UNSURE = "probable", "unsure"
Questions = dict[str, dict[str, Any]]


def questions_of(section: Any, file: str = "") -> Questions:
    """A section that may come from anybody, and the file that has it; what is not understood counts as unsure."""
    if not isinstance(section, Mapping | None):
        raise ConfigError(f"{SECTION}: found {section!r:.60}, expected KEY: {{certainty: …}}, or no such section")
    questions: Questions = {}
    for key, given in (section or {}).items():
        known = {"written": {}, **(given if isinstance(given, Mapping) else {})} | ({"file": file} if file else {})
        questions[str(key)] = {
            "certainty": PROBABLE if known.get("certainty") == PROBABLE else UNSURE,
            **{name: str(known.get(name, "")) for name in ("found", "why", "file")},
            "written": dict(known["written"]) if isinstance(known["written"], Mapping) else {},
        }
    return questions


def questions_in(content: Mapping[str, Any], path: Path) -> Questions:
    """The questions of a file that was read; of one by an `inspect` that wrote no such section, one for all of it."""
    head = path.read_text(encoding="utf-8", errors="replace")[:1000] if SECTION not in content else ""
    older = any(WRITTEN in line for line in head.splitlines() if line.startswith("#"))
    return questions_of({ALL: {"why": OLDER}} if older else content.get(SECTION), str(path))


def open_questions(settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> Questions:
    """The open questions of a whole configuration; an override decides a setting, or a section of settings."""
    given = tuple(f"{name}." for each in overrides if "." in (name := each.lstrip("+").partition("=")[0]))

    def stands(path: Any, value: Any) -> bool:
        return value == at(settings, str(path)) and not f"{path}.".startswith(given)

    known = questions_of(settings.get(SECTION)).items()
    return {k: x for k, x in known if not x["written"] or any(stands(*each) for each in x["written"].items())}


def unconfirmed(questions: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The sentence that everything says while questions are open; [] if none is."""
    if not questions:
        return []
    by = {sure: [k for k, each in questions.items() if each["certainty"] == sure] for sure in (UNSURE, PROBABLE)}
    listed = ", ".join(f"{printable(', '.join(keys))} ({sure})" for sure, keys in by.items() if keys)
    path = Path(next((each["file"] for each in questions.values() if each.get("file")), "my_boat.yaml"))
    path = path.relative_to(here) if path.is_relative_to(here := Path.cwd()) else path
    how = f"Correct {printable(str(path))}, or confirm what is right: {confirmation(path)}; then train again."
    more = next((f" {each['why']}" for each in questions.values() if each.get("why") == OLDER), "")
    return [f"{len(questions)} guess{'es' * (len(questions) > 1)} unconfirmed: {listed}.{more} {how}"]


def confirmation(path: str | Path) -> str:
    """The command that confirms questions of a file."""
    return f"usvlearn inspect --confirm KEY {printable(shlex.quote(str(path)))}"


def at(settings: Any, path: str) -> Any:
    """The value of a dotted path; None without one."""
    for name in path.split("."):
        settings = settings.get(name) if isinstance(settings, Mapping) else None
    return settings
