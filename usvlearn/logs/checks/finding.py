"""What a check finds, and the setting that corrects it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any, NamedTuple

WARNING, NOTE = "warning", "note"


class Finding(NamedTuple):
    """Something in the data that is probably a mistake (a warning), or that a reader should know (a note)."""

    boat: str
    about: str  # a channel, or several
    kind: str  # which check found it, in a word or two
    found: str  # with its number
    expected: str
    key: str = ""  # the overrides that correct it; alternatives are joined by " or "
    severity: str = WARNING

    def sentence(self) -> str:
        """The finding in one sentence, as an error says it."""
        fix = f": set {self.key}" if self.key else ""
        return f"{self.boat}, {self.about}: found {self.found}, expected {self.expected}{fix}"


def see(expected: str, *channels: str) -> str:
    """What was expected, and the channels whose name may be wrong, where the right one cannot be known."""
    return f"{expected} (see {' and '.join(f'data.channels.{each}.name' for each in channels)})"


def override(channel: str, options: Mapping[str, Any]) -> str:
    """The overrides of the command line that change a channel's options."""
    return " ".join(shlex.quote(f"data.channels.{channel}.{key}={_text(value)}") for key, value in options.items())


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    plain = all(each.isalnum() or each in "_-./*@%+|" for each in text)
    return text if plain else '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
