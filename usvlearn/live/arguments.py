"""The arguments that every `usvlearn live` command has."""

from __future__ import annotations

import argparse
from pathlib import Path

from usvlearn.core.unconfirmed import SECTION, open_questions
from usvlearn.errors import ConfigError
from usvlearn.live.node import PATIENCE
from usvlearn.live.start import Options, boat_of, channel_options


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
    add("--save-period", type=float, default=300.0, metavar="S", help="time between two checkpoints, s (300)")
    add("--keep", type=int, default=100, metavar="N", help="number of checkpoints that are kept (100)")
    add("--patience", type=float, default=PATIENCE, metavar="S",
        help=f"time for which a step waits for late messages, s ({PATIENCE})")  # fmt: skip
    add("--tensorboard", metavar="DIR", help="also write TensorBoard files there, where TensorBoard is installed")


def options_of(given: argparse.Namespace, warp: float = 1.0) -> Options:
    """The options from parsed arguments.

    Raises:
        ConfigError: a value is not legal.
    """
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
    )  # fmt: skip
