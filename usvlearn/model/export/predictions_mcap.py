"""A run's predictions and inputs as MCAP with JSON messages, which Foxglove and PlotJuggler open."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable
from typing import Any

import usvlearn
from usvlearn.errors import MissingExtraError
from usvlearn.model.export.published_steps import Stretch
from usvlearn.runs.prediction_files import UNITS

GAP = 10.0  # s between two runs, which follow each other from time 0
TOPICS = {"measured": "/usvlearn/measured", "predicted": "/usvlearn/predicted", "halfwidth": "/usvlearn/halfwidth"}


def mcap_file(boat: str, stretches: Iterable[Stretch]) -> bytes:
    """The content of a file.

    Topics: `/usvlearn/measured` (speed and inputs), `/usvlearn/predicted` and `/usvlearn/halfwidth` (a number for each
    estimator), each with `time`, s since the run's first step. A number that is unknown is left out. The stamps begin
    at 0, and the runs follow each other with 10 s between; the metadata `runs` has the stamp at which each begins.

    Raises:
        MissingExtraError: the package mcap is not installed.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise MissingExtraError("mcap", "export", "writing MCAP") from error
    content = io.BytesIO()
    writer = Writer(content)
    writer.start(profile="", library=f"usvlearn {usvlearn.__version__}")
    channels: dict[str, int] = {}
    begins: dict[str, str] = {}
    begin, end, run = 0.0, 0.0, None
    for each in stretches:
        if not channels:
            channels = {name: _channel(writer, name, topic, each) for name, topic in TOPICS.items()}
        if each.run != run:
            begin, run = (end + GAP if run is not None else 0.0), each.run
            begins[each.run] = f"{begin:.3f} s"
        for k in range(len(each.predicted)):
            time = float(each.columns["time"][k])
            end = begin + time
            stamp = round(end * 1e9)
            rows: dict[str, dict[str, float]] = {
                "measured": {name: float(values[k]) for name, values in each.columns.items()},
                "predicted": {"time": time, **dict(zip(each.estimators, each.predicted[k].tolist(), strict=True))},
                "halfwidth": {"time": time, **dict(zip(each.estimators, each.halfwidths[k].tolist(), strict=True))},
            }
            for name, row in rows.items():
                known = {key: value for key, value in row.items() if math.isfinite(value)}
                writer.add_message(channels[name], stamp, json.dumps(known).encode(), stamp)
    writer.add_metadata("runs", begins)
    writer.add_metadata("boat", {"name": boat})
    writer.finish()
    return content.getvalue()


def _channel(writer: Any, name: str, topic: str, stretch: Stretch) -> int:
    """Register a topic; returns its number."""
    own = stretch.columns if name == "measured" else ("time", *stretch.estimators)
    schema = {
        "type": "object",
        "properties": {key: {"type": "number", "description": UNITS.get(key, "m/s")} for key in own},
    }
    number = writer.register_schema(f"usvlearn.{name}", "jsonschema", json.dumps(schema).encode())
    return int(writer.register_channel(topic, "json", number))
