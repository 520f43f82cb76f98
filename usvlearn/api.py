"""From logs to predictions in a few lines of Python: `read` and `learn`. All data are NumPy arrays.

>>> import usvlearn
>>> logs = usvlearn.read(data="simulated", hours=0.1)  # or read("LOGS", "blueboat"): a log, a folder or a pattern
>>> learned = usvlearn.learn(logs)  # predicts each speed before it learns from it
>>> first = learned.predictions[0]  # first.time, s; first.measured, m/s; first.predicted["ensemble"], m/s
>>> free = learned.simulate(usvlearn.read(data="simulated", hours=0.1, seed=1, fleet_seed=0))  # from the inputs alone
>>> learned.scores["heron"]["ensemble"]["skill"] > 0 and free.scores["heron"]["joint"]["mae"] < 0.3
True

`print(logs)` and `print(learned)` show tables; `learned.save("heron.safetensors")` writes what `usvlearn.Online.open`
opens.

Like the command line, this module composes configs/: by default `learn` builds the ensemble of configs/train.yaml. No
other module imports this one. `read` imports torch for simulated logs only.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from usvlearn.errors import ConfigError, check_positive, did_you_mean
from usvlearn.learned import AlignedLogs, Learned, PathLike, check_logs

if TYPE_CHECKING:
    from usvlearn.core.protocol import Estimator
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.estimators.ensemble.state import EnsembleState


class Frame(Protocol):
    """A table with named columns, such as a `pandas.DataFrame`."""

    @property
    def columns(self) -> Any: ...

    def __getitem__(self, name: Any, /) -> Any: ...


def read(
    path: PathLike | Mapping[str, Any] | Frame | None = None,
    data: str = "csv",
    *,
    units: Mapping[str, str] | None = None,
    channels: Mapping[str, Mapping[str, Any] | None] | None = None,
    mass: float | None = None,
    surge_max: float | None = None,
    align: Mapping[str, Any] | None = None,
    check: str = "warn",
    **settings: Any,
) -> AlignedLogs:
    """Read logs, and align them on a grid of time.

    In place of logs, it takes arrays of one run: `read(time=…, command_left=…, command_right=…, heading=…, surge=…)`,
    all of the shape (time,), NaN where a channel has no value; a dictionary of them; or a table with such columns.
    Other channels of `usvlearn.logs.channels.channel.CHANNELS` and `AUXILIARY` are optional. They are in SI units,
    unless `units` or `channels` say otherwise.

    Args:
        path: a log; a folder, with all logs below it; a pattern such as `logs/*.csv`; or boat -> path. Or a dictionary
            of arrays, or a table such as a `pandas.DataFrame`.
        data: the configuration that describes them: a file such as "my_boat.yaml", or a name in configs/data: "csv",
            "alog", "rosbag", "ardupilot", "tlog", "ulog" for any boat, "blueboat", "vtec", "dalian", "pearl", or
            "simulated", which has no path.
        units: of arrays: channel, or `time` -> unit, such as `{"heading": "deg", "surge": "knots", "time": "ms"}`.
        channels: changes to it, channel -> keys of `usvlearn.logs.channels.channel.Source`.
        mass: of the boat, kg, added mass included, if it differs from that of the configuration.
        surge_max: top speed of the boat, m/s, if it differs from that of the configuration.
        align: options of `usvlearn.Aligner` that differ from configs/train.yaml, such as `{"dt": 0.2}`.
        check: the data: "warn" keeps what is found in `findings`, "strict" raises for a warning, "off" does not look.
        **settings: arrays by name; or further keys of `data`, such as `boat`, `reader` or, simulated, `n`, `hours` and
            `seed`.

    Returns:
        The aligned runs of all boats, the configuration, and what the data check has found.

    Raises:
        ConfigError: an option outside its legal values, a path that is none or finds no log, or an array that is
            missing, of another length or not of numbers.
        LogFormatError: no log can be read as it is described; with check="strict", the data check has warned.

    >>> from tempfile import TemporaryDirectory
    >>> names = {"command_left": "pwm_l", "command_right": "pwm_r", "surge": "speed"}
    >>> channels = {name: {"name": column} for name, column in names.items()}
    >>> with TemporaryDirectory() as folder:
    ...     lines = ["time,pwm_l,pwm_r,heading,speed", *(f"{k / 10},1,1,90,2" for k in range(50))]
    ...     _ = Path(folder, "heron.csv").write_text("\\n".join(lines))
    ...     logs = read(Path(folder, "heron.csv"), "csv", channels=channels, mass=28.0, surge_max=3.0)
    >>> logs.boats, len(logs.runs[0].time), float(logs.runs[0].columns["heading"][-1].round(2))
    (('heron',), 13, 1.57)
    >>> time = np.arange(0, 60, 0.1)
    >>> same = {"command_left": 0 * time + 0.5, "command_right": 0 * time + 0.5, "surge": 0 * time + 2.0}
    >>> read(time=time, **same, heading=0 * time + 90.0, units={"heading": "deg"}).rejected
    {'boat': {}}
    """
    from usvlearn.composition.alignment import CheckedAlignment
    from usvlearn.composition.configuration import compose_train, plain, recordings_of
    from usvlearn.logs.formats.array_log import NAMES, arrays_among, channels_of_arrays, described, read_arrays
    from usvlearn.logs.setup import setups_of

    arrays = arrays_among(path, settings)
    if arrays is None and units is not None:
        raise ConfigError("units: found units without arrays, expected them in channels: {'surge': {'unit': 'knots'}}")
    for name, value in settings.items():
        if hasattr(value, "__array__"):
            hint = did_you_mean(name, NAMES)
            raise ConfigError(f"{name}: found {described(value)}, expected arrays among {', '.join(NAMES)}{hint}")
    if arrays is not None:
        log, settings["channels"] = channels_of_arrays(arrays, channels, units)
    elif channels is not None:
        settings["channels"] = dict(channels)
    if isinstance(path, Mapping) and arrays is None:
        settings["path"] = {str(boat): os.fspath(each) for boat, each in path.items()}
    elif isinstance(path, str | os.PathLike):
        settings["path"] = os.fspath(path)
    vehicle = {}
    if mass is not None:
        vehicle["mass"] = check_positive("mass", mass, "of kg")
    if surge_max is not None:
        vehicle["surge_max"] = check_positive("surge_max", surge_max, "of m/s")
    changes = {"data": settings, "vehicle": vehicle, "align": dict(align or {}), "check": check}
    if arrays is None:
        lazy, composed = recordings_of(data, changes)
        recordings = list(lazy)
    else:
        if data != "csv":
            raise ConfigError(f"data: found {data!r} beside arrays, expected none: describe them in units and channels")
        composed = plain(compose_train(["data=csv"], changes))
        composed["data"]["reader"] = None
        recordings = read_arrays(log, composed["data"]["channels"], composed["data"]["boat"])
    checked = CheckedAlignment(composed)
    fleet = checked(recordings, **composed["align"])
    setups = setups_of(composed, recordings)
    return AlignedLogs(fleet, composed, tuple(checked.findings or ()), setups, tuple(recordings))


def learn(
    logs: AlignedLogs | Mapping[str, Any] | Frame,
    estimator: Estimator | None = None,
    start: PathLike | Mapping[str, PathLike] | None = None,
) -> Learned:
    """Replay logs online, each boat a batch element: predict every speed, then learn from it.

    Args:
        logs: of one boat or of several; see `read`; or a table such as a `pandas.DataFrame`, as of `read`.
        estimator: an `Ensemble`, or another estimator, to which persistence is added; by default the ensemble
            of configs/train.yaml for the boat's mass and top speed.
        start: a checkpoint to start from, or a folder of them, of which the newest is used; or boat -> either.

    Returns:
        The ensemble, its state after the last step, and all predictions with their scores.

    Raises:
        ConfigError: `logs` were not made by `read`, or `estimator` is not an estimator.
        CheckpointError: `start` cannot be read, or belongs to another ensemble.

    >>> from usvlearn import AID
    >>> learned = learn(read(data="simulated", n=2, hours=0.1), AID(mass=28.0))
    >>> learned.ensemble.names, learned.boats
    (('aid', 'persistence', 'ensemble'), ('heron1', 'heron2'))
    """
    from usvlearn.evaluation.diagnostics import events
    from usvlearn.evaluation.horizons import ensemble_scores
    from usvlearn.evaluation.metrics import fleet_scores
    from usvlearn.evaluation.season import predictions_of
    from usvlearn.runs.replay import replay

    table = isinstance(logs, Mapping) or (hasattr(logs, "columns") and not isinstance(logs, tuple))
    logs = check_logs(read(cast(Any, logs)) if table else logs)
    fleet, ensemble = logs.fleet, _ensemble(logs, estimator)
    state = ensemble.init((len(fleet.boats),))
    if start is not None:
        state = _started(state, fleet.boats, start, ensemble.description())
    parts: list[list[dict[str, np.ndarray]]] = [[] for _ in fleet.runs]
    for chunk in replay(ensemble, fleet, state):
        parts[chunk.end.run].append(chunk.published)
        state = chunk.state
    whole = [{name: np.concatenate([part[name] for part in run]) for name in run[0]} for run in parts]
    published = [(index, 0, arrays) for index, arrays in enumerate(whole)]
    scores = fleet_scores(fleet, published, ensemble.names, ensemble.surge_limit)
    predictions, forecast = predictions_of(fleet, ensemble.names, whole), ensemble_scores(ensemble, fleet, published)
    happened = events(fleet, published, ensemble.accommodated)
    return Learned(logs, ensemble, state, predictions, scores, happened, forecast)


def _ensemble(logs: AlignedLogs, estimator: Estimator | None) -> Ensemble:
    """The ensemble that `learn` runs."""
    from usvlearn.core.protocol import check_estimator
    from usvlearn.core.samples import speed_limit
    from usvlearn.estimators.baselines.persistence.layer import Persistence
    from usvlearn.estimators.ensemble.combiners.layer import Average
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.evaluation.metrics import PERSISTENCE

    if estimator is None:
        from usvlearn.composition.configuration import ensemble_of

        return ensemble_of(logs.settings)
    check_estimator("estimator", estimator)
    if isinstance(estimator, Ensemble):
        return estimator
    name = type(estimator).__name__.lower()
    members = {name: estimator} | ({} if name == PERSISTENCE else {PERSISTENCE: Persistence()})
    limit = speed_limit(logs.settings["vehicle"]["surge_max"])
    return Ensemble(members, {"ensemble": Average([name])}, surge_max=limit)


def _started(
    state: EnsembleState, boats: Sequence[str], start: PathLike | Mapping[str, PathLike], kernel: Any
) -> EnsembleState:
    """The state of all boats from saved checkpoints; see `usvlearn.runs.resuming.from_checkpoints`."""
    from usvlearn.runs.resuming import from_checkpoints

    paths = start if isinstance(start, Mapping) else dict.fromkeys(boats, start)
    if missing := [boat for boat in boats if boat not in paths]:
        raise ConfigError(f"start: found nothing for {', '.join(missing)}, expected a checkpoint of each boat")
    return from_checkpoints(state, [Path(paths[boat]) for boat in boats], kernel)[0]
