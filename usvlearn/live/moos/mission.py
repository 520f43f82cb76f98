"""Mission files of MOOS: what one file says to one app.

    ServerHost = localhost           // top level, for every app
    define: HOME_FOLDER = /home/boat
    ProcessConfig = pUSVLearn
    {
      folder = ${HOME_FOLDER}/usvlearn
    }

Keys are case-insensitive and the first of several counts. `//` begins a comment outside quotes. `${NAME}` is replaced
from a `define:` line, else from the environment. Lines that begin with `#` belong to the preprocessor of MOOS-IvP.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from usvlearn.errors import ConfigError, did_you_mean, printable

LARGEST = 1_000_000  # bytes
LISTED = 12  # names in a message
_CODE = re.compile(r'(?:"[^"]*"|(?!//).)*')  # a line up to its comment
_DEFINE = re.compile(r"\s*define:\s*([^=]*?)\s*=\s*(.*?)\s*$", re.IGNORECASE)
_BLOCK = re.compile(r"\s*ProcessConfig\s*=\s*([^{]*?)\s*(\{?)\s*$", re.IGNORECASE)
_VARIABLE = re.compile(r"\$\{([^}]*)\}")


class Entry(NamedTuple):
    """A line `key = value`."""

    key: str  # as it is written
    value: str
    line: int


class Block(NamedTuple):
    """The lines of one app."""

    name: str
    line: int
    lines: list[tuple[int, str]]  # number and text, without comments


class Mission:
    """A mission file.

    Args:
        text: all of it.
        path: for messages.
        environment: variables; those of this process by default.

    Raises:
        ConfigError: a block has no end, or a line of `ProcessConfig` no block.

    >>> mission = Mission('ServerPort = 9100 // not 9000\\nProcessConfig = pA\\n{\\n  Key = "a // b"\\n}')
    >>> mission.get("serverport").value, mission.block("pA")
    ('9100', {'key': Entry(key='Key', value='a // b', line=4)})
    """

    def __init__(self, text: str, path: str = "mission", environment: Mapping[str, str] | None = None):
        self.path = path
        self._variables = dict(os.environ if environment is None else environment)
        self._top: list[tuple[int, str]] = []
        self.blocks: list[Block] = []
        self._read(text)

    @classmethod
    def read(cls, path: Path, environment: Mapping[str, str] | None = None) -> Mission:
        """Read a mission file.

        Raises:
            ConfigError: it cannot be read, or see above.
        """
        try:
            if path.stat().st_size > LARGEST:
                raise ConfigError(
                    f"{path}: found more than {LARGEST // 1000} kB, expected a mission file: correct the path"
                )
            text = path.read_text("utf-8-sig", "surrogateescape")
        except OSError as error:
            raise ConfigError(f"{path}: found no mission file ({error.strerror}): correct the path") from error
        return cls(text, str(path), environment)

    def _read(self, text: str) -> None:
        block: Block | None = None
        opened = False
        for number, raw in enumerate(text.split("\n"), 1):
            line = _code(raw)
            if not line or line.startswith("#"):
                continue
            if define := _DEFINE.match(line):
                self._variables[define[1]] = _unquoted(define[2])
            elif block is not None and opened:
                if line.startswith("}"):
                    block = None
                else:
                    block.lines.append((number, line))
            elif found := _BLOCK.match(line):
                self._unopened(block)
                block, opened = Block(self._expanded(found[1], number), number, []), bool(found[2])
                self.blocks.append(block)
            elif block is not None:
                if not line.startswith("{"):
                    self._unopened(block)
                opened = True
            else:
                self._top.append((number, line))
        if block is not None and opened:
            raise ConfigError(
                f"{self.path}, line {block.line}: ProcessConfig = {printable(block.name)} has no end: add a line }}"
            )
        self._unopened(block)

    def _unopened(self, block: Block | None) -> None:
        if block is not None:
            raise ConfigError(
                f"{self.path}, line {block.line}: found no {{ after ProcessConfig = {printable(block.name)}, "
                "expected one on a line of its own"
            )

    def get(self, key: str) -> Entry | None:
        """The first entry of a key at the top level, outside all blocks.

        Raises:
            ConfigError: it uses a variable that is not defined.
        """
        for number, line in self._top:
            name, equals, value = line.partition("=")
            if equals and name.strip().lower() == key.lower():
                return Entry(name.strip(), _unquoted(self._expanded(value, number)), number)
        return None

    def block(self, name: str) -> dict[str, Entry]:
        """The entries of an app by key in lower case.

        Raises:
            ConfigError: the app has no block, a line is not `key = value`, a key is there twice, or a variable is not
                defined.
        """
        for block in self.blocks:
            if block.name.lower() == name.lower():
                return self._entries(block)
        names = [block.name for block in self.blocks]
        listed = ", ".join(map(printable, names[:LISTED])) or "none"
        raise ConfigError(
            f"{self.path}: found no ProcessConfig = {name}{did_you_mean(name, names)}; there are {listed}: add the "
            "block (--example shows one), or name the app by --alias"
        )

    def _entries(self, block: Block) -> dict[str, Entry]:
        found: dict[str, Entry] = {}
        for number, line in block.lines:
            key, equals, value = line.partition("=")
            entry = Entry(key.strip(), _unquoted(self._expanded(value, number)), number)
            if not equals or not entry.key:
                raise ConfigError(f"{self.path}, line {number}: found {printable(line)[:60]!r}, expected KEY = VALUE")
            if (before := found.get(entry.key.lower())) is not None:
                raise ConfigError(
                    f"{self.path}, line {number}: found {printable(entry.key)} again, which line {before.line} has: "
                    "remove one of them"
                )
            found[entry.key.lower()] = entry
        return found

    def _expanded(self, text: str, line: int) -> str:
        def value(match: re.Match[str]) -> str:
            if match[1] not in self._variables:
                raise ConfigError(
                    f"{self.path}, line {line}: found ${{{printable(match[1])}}}, which neither a define: line nor the "
                    "environment has: add `define: NAME = VALUE`"
                )
            return self._variables[match[1]]

        return _VARIABLE.sub(value, text)


def _code(line: str) -> str:
    """A line without its comment."""
    found = _CODE.match(line)
    return found[0].strip() if found else ""


def _unquoted(text: str) -> str:
    text = text.strip()
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
