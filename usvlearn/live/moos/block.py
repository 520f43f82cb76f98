"""Reads the options of the node and the address of the MOOSDB from a mission file and the command line.

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

import argparse
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import usvlearn
from usvlearn.errors import ConfigError, did_you_mean, printable
from usvlearn.live.start import NAMED, Middleware, Options, add_arguments, channel_options, options_of
from usvlearn.live.status import PLANNED, TABLE

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
    """A mission file."""

    def __init__(self, text: str, path: str = "mission", environment: Mapping[str, str] | None = None):
        self.path = path
        self._variables = dict(os.environ if environment is None else environment)
        self._top: list[tuple[int, str]] = []
        self.blocks: list[Block] = []
        self._read(text)

    @classmethod
    def read(cls, path: Path, environment: Mapping[str, str] | None = None) -> Mission:
        """Read a mission file."""
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
            elif match := _BLOCK.match(line):
                self._unopened(block)
                block, opened = Block(self._expanded(match[1], number), number, []), bool(match[2])
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
        """The first entry of a key at the top level, outside all blocks."""
        for number, line in self._top:
            name, equals, value = line.partition("=")
            if equals and name.strip().lower() == key.lower():
                return Entry(name.strip(), _unquoted(self._expanded(value, number)), number)
        return None

    def block(self, name: str) -> dict[str, Entry]:
        """The entries of an app by key in lower case."""
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
        entries: dict[str, Entry] = {}
        for number, line in block.lines:
            key, equals, value = line.partition("=")
            entry = Entry(key.strip(), _unquoted(self._expanded(value, number)), number)
            if not equals or not entry.key:
                raise ConfigError(f"{self.path}, line {number}: found {printable(line)[:60]!r}, expected KEY = VALUE")
            if (before := entries.get(entry.key.lower())) is not None:
                raise ConfigError(
                    f"{self.path}, line {number}: found {printable(entry.key)} again, which line {before.line} has: "
                    "remove one of them"
                )
            entries[entry.key.lower()] = entry
        return entries

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
    match = _CODE.match(line)
    return match[0].strip() if match else ""


def _unquoted(text: str) -> str:
    text = text.strip()
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text


NAME, HOST, PORT, TICK, PREFIX = "pUSVLearn", "localhost", 9000, 4.0, "USV_"
PLAN, ANSWER = "USVLEARN_PLAN", "USVLEARN_ALARM"  # variables
HELD = {"unit": "percent", "held": True}  # a MOOSDB keeps a value until the next post
MIDDLEWARE = Middleware(
    "MOOS",
    "usvlearn.logs.formats.moos.alog.Alog",
    {
        "command_left": {"name": "DESIRED_THRUST_L", **HELD},
        "command_right": {"name": "DESIRED_THRUST_R", **HELD},
        "heading": {"name": "NAV_HEADING", "unit": "deg"},
        "surge": {"name": "NAV_SPEED", "unit": "m/s"},
    },
    {"north": {"name": "NAV_Y", "unit": "m"}, "east": {"name": "NAV_X", "unit": "m"}},
)
NODE = ("folder", "start", "mass", "surge_max", "channels", "boat", "save_period", "keep", "patience", "tensorboard",
        "page")  # fmt: skip
SWITCHES = ("record", "refit", "members")
LEAST_TICK, MOST_TICK, MOST_WARP = 0.1, 1000.0, 500.0  # Hz, Hz, times real time
OWN = ("apptick", "prefix", "plan")
OTHERS = (  # of every app, without an effect here: messages are handled as they come
    "commstick", "maxapptick", "iteratemode", "catchcommandmessages", "term_report_interval", "max_appcast_events",
    "max_appcast_run_warnings", "app_logging",
)  # fmt: skip
KNOWN = (*NODE, *SWITCHES, *OWN, *OTHERS)
EXAMPLE = f"""// A block of a mission file. `usvlearn live moos MISSION.moos` starts the app, and pAntler with
// Run = {NAME} @ NewConsole = false
ProcessConfig = {NAME}
{{
  AppTick   = 4                       // Hz; messages are handled as they come
  CommsTick = 4

  folder      = /home/boat/usvlearn   // checkpoints, status and records; the newest readable checkpoint is continued
  start       = /home/boat/heron      // a checkpoint to start from, while the folder has none
  // mass     = 36.0                  // kg, added mass included: of a prior, if there is no checkpoint at all
  // surge_max = 3.0                  // m/s, top speed, likewise
  save_period = 300                   // s between two checkpoints
  keep        = 100                   // checkpoints
  record      = false                 // true: record all messages, so that train.py can replay the session
  refit       = true                  // false: do not fit the missions after each
  // page     = 8808                  // port of a page for a browser on this computer
  prefix      = {PREFIX}                  // of what is published
  plan        = {PLAN}         // variable: a plan that is posted there is answered by a forecast
  members     = false                 // true: publish the prediction of each member, too

  // only where other than in the checkpoint; VARIABLE@app keeps the posts of one app
  // surge         = NAV_SPEED
  // surge.unit    = knots            // m/s, km/h, knots, cm/s or mm/s
  // command_left  = DESIRED_THRUST_L
  // command_left.span = 100

  // where pMarinePID's DESIRED_THRUST is posted, and no _L and _R: it is the command of both sides
  // throttle = DESIRED_THRUST
  // and where a mixer steers by the two thrusters: left = throttle + steering, right = throttle - steering
  // steering = DESIRED_RUDDER
}}
"""


class Settings(NamedTuple):
    """What the app is given."""

    name: str  # of the app
    host: str
    port: int
    warp: float  # MOOSTimeWarp
    community: str  # empty: the database's
    tick: float  # AppTick, Hz of MOOS time
    prefix: str  # of what is published
    members: bool  # whether predictions of all members are published
    options: Options
    plan: str = PLAN  # variable by which plans are asked about


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}: see --help")


def parser() -> argparse.ArgumentParser:
    """The parser of the command line. What it says overrides the mission file."""
    parser = _Parser("usvlearn live moos", description="A node as an app of MOOS.", allow_abbrev=False)
    add = parser.add_argument
    add("mission", nargs="?", metavar="MISSION.moos", help="mission file")
    add("alias", nargs="?", metavar="ALIAS", help=f"name of this app and of its block ({NAME}); pAntler gives it")
    add("--alias", dest="other", metavar="ALIAS", help="likewise")
    add("--moos_name", metavar="ALIAS", help="likewise")
    add("--moos_host", metavar="HOST", help=f"in place of ServerHost ({HOST})")
    add("--moos_port", type=int, metavar="PORT", help=f"in place of ServerPort ({PORT})")
    add("--moos_time_warp", type=float, metavar="WARP", help="in place of MOOSTimeWarp (1)")
    add("-e", "--example", action="store_true", help="print a block of a mission file")
    add("-i", "--interface", action="store_true", help="print the variables that are subscribed to and published")
    add("-v", "--version", action="version", version=f"usvlearn {usvlearn.__version__}")
    add_arguments(parser)
    return parser


def settings_of(arguments: Sequence[str], given: argparse.Namespace) -> Settings:
    """What the app is given."""
    if given.mission is None:
        raise ConfigError("mission: found none, expected usvlearn live moos MISSION.moos: --example shows its block")
    mission = Mission.read(Path(given.mission).expanduser())
    name = given.moos_name or given.other or given.alias or NAME
    if any(each.isspace() or each in ',"' for each in name):
        raise ConfigError(f"alias: found {name!r}, expected a name without blanks, commas and quotes")
    entries = mission.block(name)
    for key, entry in entries.items():
        channel = key.partition(".")[0]
        if key not in KNOWN and channel not in NAMED:
            known = [*KNOWN, *NAMED]
            raise ConfigError(f"{_where(mission, entry)}: found no such key{did_you_mean(key, known)}")
    parse = parser()
    options = [argument for key, entry in entries.items() for argument in _argument(mission, key, entry)]
    for argument, entry in options:
        try:
            parse.parse_args([argument])
        except ConfigError as error:
            raise ConfigError(f"{_where(mission, entry)}: {error}") from error
    warp = given.moos_time_warp
    if warp is None:
        warp = _number(mission, mission.get("MOOSTimeWarp"), 1.0)
    if not 0 < warp < math.inf:
        raise ConfigError(f"--moos_time_warp: found {warp:g}, expected a positive number")
    port = given.moos_port
    if port is None:
        port = _number(mission, mission.get("ServerPort"), PORT)
    if not (1 <= port <= 65535 and port == int(port)):
        raise ConfigError(f"ServerPort: found {port:g}, expected a whole number of 1 to 65535")
    server, community, prefix = mission.get("ServerHost"), mission.get("Community"), entries.get("prefix")
    host = given.moos_host or (server.value if server else HOST)
    if not re.fullmatch(r"[\w.:%-]{1,253}", host) or ".." in host:
        raise ConfigError(f"ServerHost: found {printable(host)!r:.60}, expected a name or an address")
    plan = entries.get("plan")
    for each in (prefix, plan):
        if each is not None and (re.search(r"\s", each.value) or (each is plan and not each.value)):
            problem = f"{_where(mission, each)}: found {each.value!r:.60}"
            raise ConfigError(f"{problem}, expected one without blanks")
    tick = _number(mission, entries.get("apptick"), TICK)
    if not LEAST_TICK <= tick <= MOST_TICK:
        raise ConfigError(f"AppTick: found {tick:g}, expected {LEAST_TICK:g} to {MOST_TICK:g} Hz")
    if not warp <= MOST_WARP:
        raise ConfigError(f"MOOSTimeWarp: found {warp:g}, expected at most {MOST_WARP:g}")
    return Settings(
        name, host, int(port), warp, community.value if community else "",
        tick, PREFIX if prefix is None else prefix.value,
        _switch(mission, entries.get("members")),
        options_of(parse.parse_args([*(argument for argument, _ in options), *arguments]), warp),
        PLAN if plan is None else plan.value,
    )  # fmt: skip


def _argument(mission: Mission, key: str, entry: Entry) -> list[tuple[str, Entry]]:
    """An entry as an argument of the command line, if it is one that all nodes share."""
    if key in NODE:
        return [(f"--{key.replace('_', '-')}={entry.value}", entry)]
    if key in ("record", "refit"):
        flag = "--record" if key == "record" else "--no-refit"
        return [(flag, entry)] if _switch(mission, entry) == (key == "record") else []
    if key in KNOWN:
        return []
    try:
        channel_options({key: entry.value})
    except ConfigError as error:
        raise ConfigError(f"{mission.path}, line {entry.line}: {error}") from error
    return [(f"--channel={key}={entry.value}", entry)]


def _where(mission: Mission, entry: Entry) -> str:
    return f"{mission.path}, line {entry.line}: {printable(entry.key)}"


def _number(mission: Mission, entry: Entry | None, default: float) -> float:
    if entry is None:
        return default
    try:
        value = float(entry.value)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ConfigError(f"{_where(mission, entry)}: found {printable(entry.value)!r:.60}, expected a positive number")
    return value


def _switch(mission: Mission, entry: Entry | None) -> bool:
    text = "false" if entry is None else entry.value.lower()
    if entry is not None and text not in ("true", "false"):
        raise ConfigError(f"{_where(mission, entry)}: found {printable(entry.value)!r:.60}, expected true or false")
    return text == "true"


def interface() -> str:
    """The variables that the app subscribes to and publishes, as text."""
    lines = ["Subscribed, unless the checkpoint or the mission file names others:"]
    lines += [f"  {each['name']:<24} {part}, {each['unit']}" for part, each in MIDDLEWARE.channels.items()]
    tracks = "of a node that makes tracks"
    lines += [f"  {each['name']:<24} {part}, {each['unit']}; {tracks}" for part, each in MIDDLEWARE.auxiliary.items()]
    lines += [
        f"  {'APPCAST_REQ':<24} who asks for AppCasts",
        f"  {PLAN:<24} a plan: {PREFIX}{PLANNED} answers it",
        f"  {ANSWER:<24} acknowledge or reset: the answer to an alarm",
        "",
        f"Published (the prefix {PREFIX} can be changed):",
    ]
    lines += [
        f"  {PREFIX + each.name:<24} {each.kind}  {each.when:<12} {each.meaning}{f', {each.unit}' * bool(each.unit)}"
        for each in TABLE
    ]
    app = NAME.upper()
    lines += [
        f"  {app + '_STATUS':<24} S  every 2 s    uptime, load, memory, what is published and subscribed",
        f"  {app + '_ITER_GAP':<24} D  AppTick      time since the last iteration, times AppTick",
        f"  {app + '_ITER_LEN':<24} D  AppTick      time that the iteration and its messages took, times AppTick",
        f"  {'APPCAST':<24} S  on request   the operator's page",
        f"  {'EXITED_NORMALLY':<24} S  at the end   name of this app",
    ]
    return "\n".join(lines)
