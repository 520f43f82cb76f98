"""From where a node starts, by its options: the newest readable checkpoint of its folder, else a given one, else a
prior; and its setup.
"""

from __future__ import annotations

import argparse
import math
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.checkpoint import SUFFIX
from usvlearn.core.former_names import today
from usvlearn.core.samples import LIMIT, speed_limit
from usvlearn.core.unconfirmed import SECTION, Questions, open_questions, questions_in, unconfirmed
from usvlearn.errors import CheckpointError, ConfigError, check_not_negative, check_positive, did_you_mean
from usvlearn.live.diagnostics import PLANAR
from usvlearn.live.node import PATIENCE
from usvlearn.live.node_folder import NodeFolder, newest
from usvlearn.logs.alignment.mixing import PER_NAME, SOURCE_KEYS, STEERING, THROTTLE, listed, sides_of
from usvlearn.logs.channels.channel import AUTO, AUXILIARY, CHANNELS, COMMANDS
from usvlearn.logs.read import sources_of
from usvlearn.logs.setup import Setup

NAMED = (*CHANNELS, *AUXILIARY, THROTTLE, STEERING)  # of which a user can say something
NAMES = ("name", "field", "unit", "zero", "span", "weight", "window")  # what depends on the middleware


@dataclass(frozen=True)
class Options:
    """What the user of a node gives, whatever the middleware."""

    folder: Path  # of the node: its checkpoints, status and records
    # A checkpoint, a folder of checkpoints or a run's folder, from which to start if the folder has no checkpoint. Of a
    # run that has learned tracks, the checkpoints in its folder `planar` come first.
    start: Path | None = None
    mass: float | None = None  # kg, of a prior, if there is no checkpoint at all
    surge_max: float | None = None  # m/s, likewise
    # Changes: channel -> option of a `Source` -> value. `throttle`, or `throttle` and `steering`, stand for the
    # commands of both sides (`usvlearn.logs.alignment.mixing.sides_of`).
    channels: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    boat: str = "boat"
    record: bool = False  # the session
    save_period: float = 300.0  # s between two checkpoints
    keep: int = 100  # checkpoints
    patience: float = PATIENCE  # s, for which a step waits for late messages
    tensorboard: Path | None = None  # a folder
    warp: float = 1.0  # how many times faster than a clock the stamps run
    unconfirmed: Mapping[str, Mapping[str, Any]] | None = None  # of a file with channels; None: those of the checkpoint
    refit: bool = True  # keep the missions, and fit all of them after each
    trust: tuple[str, ...] = ()  # modules whose classes step members of the checkpoint
    page: str | None = None  # PORT or HOST:PORT at which a page for a browser is served

    def __post_init__(self) -> None:
        if not str(self.folder).strip(". ") or "\0" in str(self.folder):
            raise ConfigError(f"folder: found {str(self.folder)!r}, expected the name of a folder")
        if self.boat in ("", ".", "..") or not self.boat.isprintable() or set(self.boat) & set("/\\${}"):
            raise ConfigError(f"boat: found {self.boat!r}, expected a name that a folder can have")
        for name, value in (("mass", self.mass), ("surge_max", self.surge_max)):
            if value is not None:
                check_positive(name, value)
        check_positive("save_period", self.save_period, "of s")
        check_not_negative("patience", self.patience, "of s")
        check_positive("warp", self.warp)
        if isinstance(self.keep, bool) or not isinstance(self.keep, int) or self.keep < 2:
            raise ConfigError(f"keep: found {self.keep!r}, expected a number of checkpoints, 2 or more")


class Middleware(NamedTuple):
    """What a node assumes of a middleware where neither a checkpoint nor the user says otherwise."""

    name: str
    reader: str  # the class that reads its logs; the names in a checkpoint that was learned from such logs are its own
    channels: Mapping[str, Mapping[str, Any]]
    auxiliary: Mapping[str, Mapping[str, Any]] = {}  # likewise, for a node that makes tracks


class Begin(NamedTuple):
    """How a node begins."""

    leaves: dict[str, np.ndarray]
    facts: dict[str, Any]
    setup: Setup
    sentence: str  # what it starts from
    warnings: list[str]


def begin(folder: NodeFolder, options: Options, middleware: Middleware) -> Begin:
    """Read the checkpoint from which a node starts; without any, make a prior of a mass and a top speed."""
    leaves, facts, sentence, warnings = _found(folder, options)
    setup = _setup(facts, options, middleware)
    return Begin(leaves, facts, setup, sentence, [*warnings, *unconfirmed(setup.unconfirmed)])


def _found(folder: NodeFolder, options: Options) -> tuple[dict[str, np.ndarray], dict[str, Any], str, list[str]]:
    damaged = []
    if folder.any:
        try:
            leaves, facts, path, warnings = newest(folder.folder)
            return leaves, facts, f"continuing from {path.name} of {folder.folder}", warnings
        except CheckpointError as error:
            if options.start is None and (options.mass is None or options.surge_max is None):
                raise
            damaged = [str(error)]
    if options.start is not None:
        try:
            leaves, facts, path, warnings = _newest_of_run(options.start)
        except CheckpointError as error:
            raise CheckpointError(f"start: {error}") from error
        return leaves, facts, f"starting from {path}", [*damaged, *warnings]
    if options.mass is None or options.surge_max is None:
        raise ConfigError(
            f"{folder.folder}: found no checkpoint, and no mass and top speed for a prior: give a checkpoint to start "
            "from (start), or mass in kg and surge_max in m/s"
        )
    from usvlearn.live.prior import prior

    leaves, facts = prior(options.mass, options.surge_max)
    sentence = f"starting from the prior of a boat of {options.mass:g} kg and {options.surge_max:g} m/s"
    return leaves, facts, sentence, damaged


def _newest_of_run(start: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], Path, list[str]]:
    """As `newest`; of the folder of a run that has learned tracks, the checkpoint that makes them."""
    damaged = []
    if any((start / PLANAR).glob(f"*/*/*{SUFFIX}")):
        try:
            return newest(start / PLANAR)
        except CheckpointError as error:
            damaged = [f"no tracks: {error}"]
    leaves, facts, path, warnings = newest(start)
    return leaves, facts, path, [*damaged, *warnings]


def _setup(facts: Mapping[str, Any], options: Options, middleware: Middleware) -> Setup:
    """The checkpoint's own setup, with what depends on the middleware, and with the changes of the user."""
    try:
        known = Setup.of_set(facts)
    except ConfigError as error:
        raise CheckpointError(f"the checkpoint's {error}: use another checkpoint") from error
    planar = facts["kernel"]["kind"] == PLANAR
    known_channels = {} if known is None else known.json()["channels"]
    if known is not None and known.reader == middleware.reader:
        channels = {name: dict(each) for name, each in known_channels.items()}
    else:  # the names in the checkpoint are those of another kind of log
        defaults = {**middleware.channels, **(middleware.auxiliary if planar else {})}
        channels = {name: dict(each) for name, each in defaults.items()}
        for name, given in known_channels.items():
            if name in channels:
                own_options = {key: value for key, value in given.items() if key not in NAMES}
                channels[name] = own_options | channels[name]
    for name, changes in _sided(options.channels).items():
        if name not in (*CHANNELS, *AUXILIARY):
            raise ConfigError(
                f"channels: found {name!r}, expected one of {', '.join(CHANNELS)}{did_you_mean(name, CHANNELS)}"
            )
        channels[name] = _changed(channels.get(name, {}), changes)
    if THROTTLE in options.channels:
        _check_alike(channels, _sided(options.channels)[COMMANDS[0]])
    for given in channels.values():
        given.setdefault("window", AUTO)
        if given.get("period") == AUTO:
            given["period"] = 0.0  # live messages do not tell it
    declared = sources_of(channels)
    align = {} if known is None else dict(known.align)
    align["patience"] = options.patience
    mass = options.mass if known is None or known.mass is None else known.mass
    top = options.surge_max if known is None or known.surge_max is None else known.surge_max  # of its estimators
    if (limit := speed_limit(max(top or 0.0, options.surge_max or 0.0))) > LIMIT:
        align.setdefault("surge_max", limit)
    asked = options.unconfirmed if known is None or options.unconfirmed is not None else known.unconfirmed
    setup = Setup(declared, align, mass, top, middleware.reader, asked or {})
    return setup if planar else setup.live()


def _sided(channels: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The channels, with the commands of both sides in place of throttle and steering."""
    sided = dict(channels)
    throttle, steering = (sided.pop(name, None) for name in (THROTTLE, STEERING))
    if throttle is None and steering is None:
        return sided
    if throttle is None:
        raise ConfigError(f"{STEERING}: found it without {THROTTLE}, expected both: name the throttle, too")
    if sides := [name for name in COMMANDS if name in sided]:
        raise ConfigError(f"{sides[0]}: found it beside {THROTTLE}, expected one of them: leave one out")
    return sided | sides_of(throttle, steering)


def _check_alike(channels: Mapping[str, Mapping[str, Any]], changes: Mapping[str, Any]) -> None:
    """Refuse a throttle that would have two meanings, because the sides of the checkpoint differ in an option."""
    left, right = (channels[side] for side in COMMANDS)
    for key in sorted(left.keys() | right.keys()):
        if key not in changes and left.get(key) != right.get(key):
            raise ConfigError(
                f"{THROTTLE}: found {key} {left.get(key)!r} of {COMMANDS[0]} and {right.get(key)!r} of {COMMANDS[1]} "
                f"in the checkpoint, expected one for both: give {THROTTLE}.{key}"
            )


def _changed(options: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a channel with those of the user; where several signals make it, and now one, or the reverse, the
    former options of each are left out.
    """
    if "name" in changes and (listed(options.get("name")) is None) != (listed(changes["name"]) is None):
        options = {
            key: value
            for key, value in options.items()
            if key not in (*PER_NAME, "weight") or (key == "unit" and listed(value) is None)
        }
    return {**options, **changes}


def channel_options(given: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Changes to channels from text by dotted key: {"surge": "NAV_SPEED"}, comma-separated names, or "surge.unit"."""
    changes: dict[str, dict[str, Any]] = {}
    for dotted, text in given.items():
        channel, _, key = dotted.partition(".")
        key = key or "name"
        if channel not in NAMED or key not in SOURCE_KEYS:
            if channel in NAMED:
                hint = did_you_mean(dotted, [f"{channel}.{each}" for each in SOURCE_KEYS])
            else:
                hint = did_you_mean(channel, NAMED) or f": channels are {', '.join(CHANNELS)}"
            raise ConfigError(f"{dotted}: found no such option of a channel, such as surge or surge.unit{hint}")
        changes.setdefault(channel, {})[key] = _value(dotted, key, str(text).strip())
    return changes


def _value(dotted: str, key: str, text: str) -> Any:
    """A value from text, of the type that the option of a `Source` has."""
    items = [each.strip() for each in text.split(",")]
    if key in ("name", "unit", "field"):
        return (items if key == "name" and len(items) > 1 else text) or None
    if key == "window" and text == AUTO:
        return AUTO
    if key == "held":
        if text.lower() not in ("true", "false"):
            raise ConfigError(f"{dotted}: found {text!r}, expected true or false")
        return text.lower() == "true"
    try:
        values = [float(each) for each in items]
    except ValueError as error:
        more = f", or {AUTO}" if key == "window" else ""
        raise ConfigError(f"{dotted}: found {text!r}, expected a number{more}") from error
    if not all(map(math.isfinite, values)):
        raise ConfigError(f"{dotted}: found {text!r}, expected a finite number")
    return values if len(values) > 1 or key == "weight" else values[0]


def boat_of(path: Path) -> tuple[dict[str, dict[str, Any]], dict[str, float], Questions]:
    """The channels, mass and top speed, and open questions of a configuration of data, as `usvlearn inspect` writes."""
    try:
        from usvlearn.core.safe_yaml import read_yaml
    except ImportError as error:
        raise ConfigError("channels: PyYAML is not installed here: run `pip install pyyaml`") from error
    content = today(read_yaml("channels", path))
    data, vehicle = content.get("data"), content.get("vehicle")
    channels = data.get("channels") if isinstance(data, dict) else None
    if not isinstance(channels, dict) or not all(isinstance(each, dict | None) for each in channels.values()):
        raise ConfigError(f"channels: {path} has no data.channels: name a file that usvlearn inspect wrote")
    known = vehicle if isinstance(vehicle, dict) else {}
    numbers = {name: known[name] for name in ("mass", "surge_max") if isinstance(known.get(name), int | float)}
    listed = {name: dict(each) for name, each in channels.items() if each is not None}
    return listed, numbers, questions_in(content, path)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add them to the parser of a middleware."""
    group = parser.add_argument_group("the node")
    add = group.add_argument
    add("--folder", default="usvlearn_live", help="folder for checkpoints, status and records (usvlearn_live)")
    add(
        "--start",
        metavar="CHECKPOINT",
        help="a checkpoint, a folder of checkpoints or a run's folder, if the node's folder has no checkpoint yet; a "
        "run that has learned tracks starts a node that makes them",
    )
    add("--mass", type=float, help="mass in kg, added mass included; needed only without a checkpoint")
    add("--surge-max", type=float, help="top speed in m/s; needed only without a checkpoint")
    add("--channels", metavar="FILE.yaml", help="channels as usvlearn inspect writes them")
    add("--channel", action="append", default=[], metavar="KEY=VALUE",
        help="an option of a channel, such as surge=NAV_SPEED or command_left.span=100; repeatable")  # fmt: skip
    add("--boat", default="boat", help="name of the boat")
    add("--record", action="store_true", help="record all messages, so that train.py can replay the session")
    add("--no-refit", dest="refit", action="store_false", help="keep no missions, and do not fit them after each")
    add("--trust", action="append", default=[], metavar="MODULE",
        help="a module, which is imported: its classes are members of the ensemble; repeatable")  # fmt: skip
    add("--save-period", type=float, default=300.0, metavar="S", help="time between two checkpoints, s (300)")
    add("--keep", type=int, default=100, metavar="N", help="number of checkpoints that are kept (100)")
    add("--patience", type=float, default=PATIENCE, metavar="S",
        help=f"time for which a step waits for late messages, s ({PATIENCE})")  # fmt: skip
    add("--tensorboard", metavar="DIR", help="also write TensorBoard files there, where TensorBoard is installed")
    add("--page", nargs="?", const="8808", metavar="PORT",
        help="serve a page for a browser on this computer (8808), or with HOST:PORT for others")  # fmt: skip


def options_of(given: argparse.Namespace, warp: float = 1.0) -> Options:
    """The options from parsed arguments."""
    channels, vehicle, asked = boat_of(Path(given.channels).expanduser()) if given.channels else ({}, {}, None)
    pairs = {}
    for pair in given.channel:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ConfigError(f"--channel: found {pair!r}, expected KEY=VALUE, such as surge=NAV_SPEED")
        pairs[key.strip()] = value
    for name, each in channel_options(pairs).items():
        channels[name] = channels.get(name, {}) | each
    mass, top = (
        vehicle.get(name) if value is None else value
        for name, value in (("mass", given.mass), ("surge_max", given.surge_max))
    )
    if asked is not None:  # by what the file and the options say together, as far as a node uses it
        used = {"data": {"channels": channels}, "vehicle": {"mass": mass, "surge_max": top}}
        asked = open_questions({**used, SECTION: asked})
    return Options(
        Path(given.folder).expanduser(), None if given.start is None else Path(given.start).expanduser(), mass,
        top, channels, given.boat, given.record, given.save_period, given.keep, given.patience,
        None if given.tensorboard is None else Path(given.tensorboard).expanduser(), warp, asked, given.refit,
        tuple(given.trust),
        given.page,
    )  # fmt: skip


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set; the handlers before are put back."""
    stopped = threading.Event()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, lambda *_: stopped.set())
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
