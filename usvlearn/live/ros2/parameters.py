"""The parameters of the node in ROS 2: the options of every node, those of its own, and the channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.live.start import NAMED, Options
from usvlearn.logs.alignment.mixing import SOURCE_KEYS
from usvlearn.logs.formats.ros.message_fields import CLOCKS

PREFIX = "channels."
PATHS = ("folder", "start", "tensorboard")
OWN = {"frame_id": "base_link", "clock": "header", "members": False}  # and their defaults
KINDS: dict[str, tuple[type, ...]] = {  # of all options; a whole number is legal where a number is
    **dict.fromkeys((*PATHS, "boat", "frame_id", "clock"), (str,)),
    **dict.fromkeys(("mass", "surge_max", "save_period", "patience"), (float, int)),
    "keep": (int,),
    **dict.fromkeys(("record", "refit", "members"), (bool,)),
}
OF_ROS = ("use_sim_time", "start_type_description_service")
PREFIXES_OF_ROS = ("qos_overrides.",)
MEANING = {str: "text", bool: "true or false", int: "a whole number", float: "a number"}


class Given(NamedTuple):
    """What the user has given as parameters."""

    options: dict[str, Any]  # of `usvlearn.live.start.Options`
    own: dict[str, Any]  # of `OWN`, complete
    channels: dict[str, dict[str, Any]]  # channel -> option of a `Source` -> value


def given_by(parameters: Mapping[str, Any]) -> Given:
    """Sort parameters, by their full names.

    Args:
        parameters: name -> value. The names of channels begin with "channels.", as in "channels.surge.name".

    Raises:
        ConfigError: a name is not known, or a value has another type than expected.

    >>> given = given_by({"mass": 36, "channels.surge.name": "/odom", "members": True})
    >>> given.options, given.channels, given.own["members"]
    ({'mass': 36}, {'surge': {'name': '/odom'}}, True)
    >>> given_by({"masss": 36.0})
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: parameter masss: found no such parameter: did you mean mass?
    """
    found = Given({}, dict(OWN), {})
    for name, value in parameters.items():
        if name in OF_ROS or name.startswith(PREFIXES_OF_ROS):
            continue
        if name.startswith(PREFIX):
            channel, _, key = name.removeprefix(PREFIX).partition(".")
            if channel not in NAMED or key not in SOURCE_KEYS:
                raise _unknown(name, (PREFIX + f"{each}.{option}" for each in NAMED for option in SOURCE_KEYS))
            found.channels.setdefault(channel, {})[key] = _plain(value)
            continue
        if name not in KINDS:
            raise _unknown(name, KINDS)
        if not isinstance(value, KINDS[name]) or (isinstance(value, bool) and bool not in KINDS[name]):
            raise ConfigError(f"parameter {name}: found {value!r:.60}, expected {MEANING[KINDS[name][0]]}")
        if name in OWN:
            found.own[name] = value
        elif value != "":  # an empty text leaves the default, as a launch file may pass it
            found.options[name] = Path(str(value)).expanduser() if name in PATHS else value
    if found.own["clock"] not in CLOCKS:
        raise ConfigError(f"parameter clock: found {found.own['clock']!r}, expected one of {', '.join(CLOCKS)}")
    return found


def with_parameters(options: Options, given: Given) -> Options:
    """The options of the command line, with the parameters in their place."""
    channels = {name: dict(each) for name, each in options.channels.items()}
    for name, each in given.channels.items():
        channels[name] = channels.get(name, {}) | each
    return replace(options, **given.options, channels=channels)


def _unknown(name: str, known: Iterable[str]) -> ConfigError:
    return ConfigError(f"parameter {name}: found no such parameter{did_you_mean(name, known)}")


def _plain(value: Any) -> Any:
    """The arrays of ROS as lists."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
