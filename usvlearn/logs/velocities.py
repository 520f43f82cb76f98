"""Logs with several components of the velocity, such as surge, sway and yaw rate, on one grid of time.

Each component is aligned as `usvlearn.logs.alignment.align` aligns the surge: the target of the step from t_k to t_k +
dt is the last message of the component in it. The grid starts with the first message of the component, so all
components have to come with the same stamps, as the fields of one message do.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import VectorSample
from usvlearn.errors import ConfigError, LogFormatError, UsvlearnError
from usvlearn.logs.alignment.align import Aligned, align
from usvlearn.logs.channels.channel import CHANNELS, SURGE, Source
from usvlearn.logs.channels.series import Reader
from usvlearn.logs.read import read_recordings


class VectorRun(NamedTuple):
    """One log on the grid.

    >>> from usvlearn.simulate.planar import planar_runs
    >>> samples, _ = planar_runs(seed=0, minutes=0.5, runs=1)
    >>> VectorRun("001", np.cumsum(samples.inputs.dt[:, 0]), samples).name
    '001'
    """

    name: str  # of the log, without its suffix
    time: np.ndarray  # (time,) s since the log's start
    samples: VectorSample  # leaves (time,), and (time, components)


def read_velocities(
    path: str | os.PathLike,
    reader: Reader,
    channels: Mapping[str, Source | Mapping | None],
    components: Mapping[str, Source | Mapping],
    boat: str | None = None,
    limits: Mapping[str, float] | None = None,
    **options: Any,
) -> list[VectorRun]:
    """Read all logs of one boat.

    Args:
        path: as of `usvlearn.logs.read.read_recordings`.
        reader: likewise.
        channels: the commands, the heading, and perhaps the yaw rate as an input, as there.
        components: name -> where it is logged, in SI units: m/s, m/s, rad/s. In their order they are the components of
            `VectorSample.velocity`. Another unit is converted by `span`.
        boat: as `path`.
        limits: name -> the size beyond which a message is rejected, in SI units; 10 by default.
        **options: of `usvlearn.Aligner`, but for `surge_max`.

    Returns:
        The runs in the order of the logs.

    Raises:
        ConfigError: no component, a surge among the channels, or a limit of something else.
        LogFormatError: a log cannot be read, or two components have other stamps.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from usvlearn.logs.formats.csv.table import Table
    >>> inputs = {"command_left": {"name": "L"}, "command_right": {"name": "R"}, "heading": {"name": "psi"}}
    >>> components = {"surge": {"name": "u"}, "sway": {"name": "v"}}
    >>> with TemporaryDirectory() as folder:
    ...     rows = [f"{k / 10},0.5,0.5,0,1.0,{k / 100}" for k in range(9)]
    ...     _ = Path(folder, "run.csv").write_text("\\n".join(["t,L,R,psi,u,v", *rows]))
    ...     runs = read_velocities(folder, Table("t"), inputs, components, dt=0.4)
    >>> runs[0].name, runs[0].samples.velocity.tolist()
    ('run', [[1.0, 0.0], [1.0, 0.04], [1.0, 0.08]])
    """
    if not components or SURGE in channels:
        what = "surge among the channels" if components else "no component"
        raise ConfigError(f"components: found {what}, expected surge, sway or yaw_rate there, each with its name")
    if not isinstance(components, Mapping):
        raise ConfigError(f"components: found {components!r:.80}, expected where each is logged: {{name: {{name: …}}}}")
    if unknown := [name for name in limits or {} if name not in components]:
        raise ConfigError(f"limits: found {unknown[0]!r}, expected components: {', '.join(components)}")
    aligned: dict[str, list[Aligned]] = {}
    for name, source in components.items():
        with _named_as_here(name):
            recordings = read_recordings(path, reader, {**channels, SURGE: source}, boat)
        most = (limits or {}).get(name, 10.0)
        aligned[name] = [align(_inputs_and(each.channels), surge_max=most, **options) for each in recordings]
        runs = [recording.run for recording in recordings]
    first, found = next(iter(aligned)), []
    for k, run in enumerate(runs):
        parts = {name: logs[k] for name, logs in aligned.items()}
        time, samples = parts[first].time, parts[first].samples
        for name, other in parts.items():
            if other.time.shape != time.shape or not np.allclose(other.time, time, rtol=0, atol=1e-6):
                raise LogFormatError(
                    f"{run}: found other stamps of {name} than of {first}, expected both in the same messages: name "
                    "fields of one message, or leave one component out"
                )
        velocity = np.stack([each.samples.surge for each in parts.values()], -1)
        fresh = np.logical_and.reduce([each.samples.fresh for each in parts.values()])
        measured = np.stack([each.samples.measured for each in parts.values()], -1)
        found.append(VectorRun(run, time, VectorSample(samples.inputs, velocity, fresh, measured)))
    return found


@contextmanager
def _named_as_here(component: str) -> Iterator[None]:
    """A context in which an error names the arguments of `read_velocities`, in place of the keys of a configuration."""
    try:
        yield
    except UsvlearnError as error:
        text = str(error).replace(f"data.channels.{SURGE}", f"components.{component}")
        error.args = (re.sub(r"\bdata\.(path|reader|channels)", r"\1", text),)
        raise


def _inputs_and(channels: Mapping[str, Any]) -> dict[str, Any]:
    """The channels that an `Aligner` takes, without those of a track."""
    return {name: channels[name] for name in CHANNELS if name in channels}
