"""The only table of former names: what has another name since version 0.3, which opens nothing of 0.1 and 0.2.

It is applied where settings, descriptions and states enter: checkpoints, configurations, YAML files of boats.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TARGETS = {  # classes in settings; the first six are in the boats' files of `usvlearn inspect` of version 0.2
    "usvlearn.logs.alog.Alog": "usvlearn.logs.formats.moos.alog.Alog",
    "usvlearn.logs.csv_table.Table": "usvlearn.logs.formats.csv.table.Table",
    "usvlearn.logs.dataflash.DataFlash": "usvlearn.logs.formats.ardupilot.dataflash.DataFlash",
    "usvlearn.logs.rosbag.Rosbag": "usvlearn.logs.formats.ros.rosbag.Rosbag",
    "usvlearn.logs.tlog.Tlog": "usvlearn.logs.formats.ardupilot.tlog.Tlog",
    "usvlearn.logs.ulog.Ulog": "usvlearn.logs.formats.px4.ulog.Ulog",
}
KEYS = {"read_every": "estimate_every"}  # keys of settings, descriptions; parts of the dotted names of a state's arrays


def today(content: Any, levels: int = 100) -> Any:
    """Settings, a description or arrays with the names of today; nested deeper than `levels` they stay unchanged."""
    if isinstance(content, list) and levels:
        return [today(each, levels - 1) for each in content]
    if not isinstance(content, Mapping) or not levels:
        return TARGETS.get(content, content) if isinstance(content, str) else content
    names = {key: ".".join(KEYS.get(part, part) for part in key.split(".")) for key in content if isinstance(key, str)}
    return {names.get(key, key): today(value, levels - 1) for key, value in content.items()}
