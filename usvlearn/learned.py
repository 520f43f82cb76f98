"""What `usvlearn.read` and `usvlearn.learn` return: logs, predictions and what was learned, as NumPy arrays."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.core.samples import UNITS, Fleet, Sample, masks, named_leaves, tree_map
from usvlearn.errors import ConfigError
from usvlearn.evaluation.season import Predictions, measured_surge, pandas, predictions_of, samples_of

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.estimators.ensemble.state import EnsembleState
    from usvlearn.estimators.joint.periodic_estimates import Identified
    from usvlearn.logs.channels.channel import Recording
    from usvlearn.logs.checks.finding import Finding
    from usvlearn.logs.setup import Setup
    from usvlearn.model.fit.fitted import Fitted

PathLike = str | os.PathLike[str]


class AlignedRun(NamedTuple):
    """A run of one boat on a grid of time.

    >>> from usvlearn import read
    >>> run = read(data="simulated", hours=0.05).runs[0]
    >>> run.boat, run.time.shape == run.columns["surge"].shape
    ('heron', True)
    """

    boat: str  # its name
    name: str  # of the run, within its boat
    time: np.ndarray  # (time,) s since its first step
    samples: Sample  # leaves (time,)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """All arrays by name, `(time,)` each; `usvlearn.core.samples.UNITS` has their units.

        A `dt` of 0 starts a segment; `surge` is NaN where it was not measured.
        """
        leaves = {name.rpartition(".")[2]: leaf for name, leaf in named_leaves(self.samples)}
        return {"time": self.time, **leaves, "surge": measured_surge(self.samples)}

    def to_pandas(self) -> Any:
        """`columns` as a table: of steps, whose inputs are means over the step that ends there.

        Returns:
            A `pandas.DataFrame`, one row a step; its `attrs["units"]` has the units. `read` takes a table of messages
            instead: of this one, it would see the commands a step late.

        Raises:
            MissingExtraError: pandas is not installed.

        >>> from usvlearn import read
        >>> run = read(data="simulated", hours=0.05).runs[0]
        >>> run.to_pandas().columns[-1]  # doctest: +SKIP
        'measured'
        """
        frame = pandas().DataFrame(self.columns)
        frame.attrs["units"] = UNITS
        return frame


class _Tables:
    """Shows what `_parts` returns: as text in a terminal, and as HTML of the same look in a notebook."""

    def _parts(self) -> Sequence[Any]:
        raise NotImplementedError

    def __repr__(self) -> str:
        from usvlearn.display.terminal import console

        board = console()
        with board.capture() as captured:
            board.print(*filter(None, self._parts()), sep="\n")
        return captured.get().rstrip()

    def _repr_html_(self) -> str:
        from rich.console import Console

        board = Console(record=True, file=io.StringIO(), width=120, markup=False)
        board.print(*filter(None, self._parts()), sep="\n")
        return board.export_html(inline_styles=True, code_format="<pre>{code}</pre>")


@dataclass(frozen=True, repr=False)
class AlignedLogs(_Tables):
    """The result of `read`: the runs of one or several boats on a grid of time.

    Attributes:
        fleet: all boats side by side, as estimators take them.
        settings: the whole configuration, as in train.py.
        findings: of the data check, warnings first; see `usvlearn.logs.checks.data_check`.
        setups: boat -> how its messages became samples.
        recordings: the messages themselves, which a fit aligns again on a finer grid.

    >>> from usvlearn import read
    >>> logs = read(data="simulated", n=2, hours=0.1)
    >>> logs.boats, logs.runs[0].boat, len(logs.fleet.runs)
    (('heron1', 'heron2'), 'heron1', 1)
    """

    fleet: Fleet
    settings: Mapping[str, Any]
    findings: tuple[Finding, ...] = ()
    setups: Mapping[str, Setup] = field(default_factory=dict)
    recordings: tuple[Recording, ...] = ()

    @property
    def boats(self) -> tuple[str, ...]:
        """The names of the boats."""
        return self.fleet.boats

    @property
    def runs(self) -> tuple[AlignedRun, ...]:
        """All runs of all boats, in the order in which they are learned."""
        return tuple(
            AlignedRun(boat, run.names[element], run.time[:n, element], samples_of(run.samples, n, element))
            for run in self.fleet.runs
            for element, boat in enumerate(self.boats)
            if (n := run.lengths[element])
        )

    @property
    def rejected(self) -> dict[str, dict[str, dict[str, int]]]:
        """How many messages or steps were rejected: boat -> channel -> cause -> count."""
        return self.fleet.rejected

    def to_pandas(self) -> Any:
        """All runs as one table.

        Returns:
            A `pandas.DataFrame`, one row a step: the columns of each run, then `boat` and `run`.

        Raises:
            MissingExtraError: pandas is not installed.

        >>> from usvlearn import read
        >>> read(data="simulated", hours=0.05).to_pandas().groupby("run")["surge"].mean()  # doctest: +SKIP
        """
        frames = [run.to_pandas().assign(boat=run.boat, run=run.name) for run in self.runs]
        return pandas().concat(frames, ignore_index=True)

    def _parts(self) -> Sequence[Any]:
        from usvlearn.display.terminal import Blocks
        from usvlearn.report.tables import data_check_table, rejection_table

        table = Blocks("Logs on the grid of time", ["run"], ["minutes", "steps", "measured"])
        boat = None
        for run in self.runs:
            if run.boat != boat:
                table.group(boat := run.boat)
            minutes = (run.time[-1] - run.time[0]) / 60
            table.add(run.name, f"{minutes:.1f}", str(len(run.time)), f"{run.samples.measured.mean():.1%}")
        checks = data_check_table([each._asdict() for each in self.findings]) if self.findings else None
        return table, rejection_table(self.rejected), checks


@dataclass(frozen=True, repr=False)
class Simulated(_Tables):
    """A simulation from the inputs and the speed at which each segment starts; nothing is learned.

    Attributes:
        predictions: per run and boat.
        scores: boat -> member or combiner -> MAE and others, m/s; see `usvlearn.evaluation.metrics.scores`.

    >>> from usvlearn import AID, learn, read
    >>> logs = read(data="simulated", hours=0.1)
    >>> simulated = learn(logs, AID(mass=28.0)).simulate(logs)
    >>> len(simulated.predictions) == len(logs.runs), simulated.predictions[0].halfwidth
    (True, {})
    """

    predictions: tuple[Predictions, ...]
    scores: dict[str, dict[str, dict[str, Any]]]

    def _parts(self) -> Sequence[Any]:
        from usvlearn.report.tables import score_table

        return [score_table(self.scores, title="Simulation of surge from the inputs alone, errors in m/s, by MAE")]


@dataclass(frozen=True, repr=False)
class Learned(_Tables):
    """The result of `learn`: an ensemble, its final state for each boat, and all of its predictions.

    Attributes:
        logs: the logs it has learned from.
        ensemble: its members and combiners.
        state: at the end, leaves `(boats, …)`: a checkpoint of each boat.
        predictions: per run and boat.
        scores: boat -> member or combiner -> MAE, skill against persistence and others; see
            `usvlearn.evaluation.metrics.scores`.
        events: boat -> losses of thrust, recoveries and other changes; see `usvlearn.evaluation.diagnostics.events`.
        forecast_scores: boat -> estimator -> horizon -> scores; see `usvlearn.evaluation.horizons.horizon_scores`.

    >>> from usvlearn import AID, learn, read
    >>> logs = read(data="simulated", hours=0.1)
    >>> learned = learn(logs, AID(mass=28.0))
    >>> sorted(learned.scores["heron"]), learned.predictions[0].boat
    (['aid', 'ensemble', 'persistence'], 'heron')
    >>> learned.simulate(logs).scores["heron"]["aid"]["mae"] < 0.5
    True
    """

    logs: AlignedLogs
    ensemble: Ensemble
    state: EnsembleState
    predictions: tuple[Predictions, ...]
    scores: dict[str, dict[str, dict[str, Any]]]
    events: dict[str, list[dict[str, Any]]]
    forecast_scores: dict[str, dict[str, dict[str, dict[str, Any]]]] = field(default_factory=dict)

    @property
    def boats(self) -> tuple[str, ...]:
        """The names of the boats."""
        return self.logs.boats

    def simulate(self, logs: AlignedLogs) -> Simulated:
        """Simulate each run of some logs with its boat's parameters. Parameters of a single boat serve all boats.

        Args:
            logs: of the same boats, such as those of another day.

        Returns:
            The simulated speeds of each run, and their scores.

        Raises:
            ConfigError: the logs were not made by `read`, or nothing was learned of one of their boats.
        """
        import torch

        from usvlearn.engine.rollouts import simulate, tensors
        from usvlearn.evaluation.metrics import fleet_scores

        elements = [0 if len(self.boats) == 1 else self._element(boat) for boat in check_logs(logs).boats]
        state = tree_map(lambda leaf: leaf[elements], self.state)
        published = []
        for run in logs.fleet.runs:
            with torch.no_grad():
                samples = tensors(run.samples, state.predictions.dtype)
                _, _, recorded = simulate(self.ensemble, state, samples, record=["predictions"])
            stepped = masks(run.samples, self.ensemble.surge_limit).steps
            published.append({"predictions": np.where(stepped[..., None], recorded["predictions"].numpy(), np.nan)})
        names, stretches = self.ensemble.names, [(index, 0, arrays) for index, arrays in enumerate(published)]
        scores = fleet_scores(logs.fleet, stretches, names, self.ensemble.surge_limit)
        return Simulated(predictions_of(logs.fleet, names, published), scores)

    def identified(self) -> dict[str, Identified]:
        """The physical quantities of each boat by name, with 90 % intervals; `print` shows one as a table.

        Returns:
            Of each boat by name.

        Raises:
            ConfigError: the ensemble has no averaged joint EKF (`configs/estimator/joint_averaged.yaml`).

        >>> from usvlearn import AID, learn, read
        >>> learn(read(data="simulated", hours=0.05), AID(mass=28.0)).identified()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        usvlearn.errors.ConfigError: ...
        """
        from usvlearn.evaluation.diagnostics import identified_boats

        return identified_boats(self.ensemble, self.state, self.boats, required=True)

    def fit(self, terms: str | None = None) -> dict[str, Fitted]:
        """The best parameters that the logs can give, of each boat by name; `print` shows one as a table.

        The physical model, with curves of thrust and drag, is fitted to all missions at once, in open loop
        (`usvlearn.model.fit.gauss_newton`). `usvlearn fit RUN` also says whether the fit or the ensemble simulates a
        boat better, which needs what the ensemble was after half of a run.

        Args:
            terms: a name of `usvlearn.model.fit.terms.SETS`, in place of the set that does best on missions which it
                has not learned.

        Returns:
            Of each boat by name.

        Raises:
            ConfigError: there is no such set; the logs have no messages, as those of a `Fleet`; too little was
                measured while a boat moved; or its commands never changed.

        >>> from usvlearn import AID, learn, read
        >>> fits = learn(read(data="simulated", hours=0.2), AID(mass=28.0)).fit(terms="cubic")
        >>> print(round(fits["heron"].quantities["steady_speed_full"].value, 1))
        2.6
        """
        from usvlearn.evaluation.diagnostics import identified_boats
        from usvlearn.logs.recordings import align_fleet
        from usvlearn.model.fit.fitted import fit_boat
        from usvlearn.model.fit.logs import fine, missions_of

        if not self.logs.recordings:
            raise ConfigError("fit: found logs without their messages, expected those that usvlearn.read has made")
        fleet = align_fleet(self.logs.recordings, **fine(self.logs.settings["align"]))
        mass, top = (float(self.logs.settings["vehicle"][name]) for name in ("mass", "surge_max"))
        online = identified_boats(self.ensemble, self.state, self.boats)
        return {
            boat: fit_boat(boat, missions_of(fleet, boat), mass, top, terms, online=online.get(boat))
            for boat in self.boats
        }

    def save(self, path: PathLike, boat: str | None = None, fit: Fitted | None = None) -> Path:
        """Write a boat's checkpoint, which `usvlearn.Online.open`, `learn(start=)` and train.py's `resume` take.

        Args:
            path: of the file; its folder is created.
            boat: its name; not needed if there is only one.
            fit: of this boat, from which its joint EKFs are to go on.

        Returns:
            The path.

        Raises:
            ConfigError: there is no such boat, or there are several and none is named.

        >>> from tempfile import TemporaryDirectory
        >>> from usvlearn import AID, Online, learn, read
        >>> learned = learn(read(data="simulated", hours=0.05), AID(mass=28.0))
        >>> with TemporaryDirectory() as folder:
        ...     Online.open(learned.save(f"{folder}/heron.safetensors")).names
        ('aid', 'persistence', 'ensemble')
        """
        import usvlearn
        from usvlearn.core import checkpoint
        from usvlearn.engine import select_element
        from usvlearn.runs.files import ESTIMATOR

        if boat is None and len(self.boats) > 1:
            raise ConfigError(f"boat: found none, expected one of {', '.join(self.boats)}")
        element = 0 if boat is None else self._element(boat)
        last = next(run for run in reversed(self.predictions) if run.boat == self.boats[element])
        state: Any = tree_map(lambda leaf: leaf[element].detach(), self.state)
        kernel, fitted = select_element(self.ensemble.description(), len(self.boats), element), dict[str, Any]()
        if fit is not None:
            from usvlearn.model.fit.hand_over import handed_over

            mass = float(self.logs.settings["vehicle"]["mass"])
            if fit.boat != self.boats[element] or fit.identified.mass != mass:
                raise ConfigError(
                    f"fit: found that of {fit.boat}, {fit.identified.mass:g} kg, expected one of "
                    f"{self.boats[element]}, {mass:g} kg"
                )
            leaves = {name: leaf.numpy() for name, leaf in named_leaves(state)}
            state, fitted = handed_over(leaves, kernel, fit, float(self.logs.settings["align"]["dt"]))
        return checkpoint.save(
            Path(path),
            state,
            estimator=ESTIMATOR,
            kernel=kernel,
            **fitted,
            boat=last.boat,
            run=last.run,
            step=len(last.time),
            time=float(last.time[-1]),
            version=usvlearn.__version__,
            **({"setup": setup.json()} if (setup := self.logs.setups.get(self.boats[element])) else {}),
        )

    def _element(self, boat: str) -> int:
        if boat in self.boats:
            return self.boats.index(boat)
        raise ConfigError(
            f"boat: found {boat!r}, of which nothing was learned, expected one of {', '.join(self.boats)}"
        )

    def _parts(self) -> Sequence[Any]:
        from usvlearn.evaluation.diagnostics import explained, remarks
        from usvlearn.report.tables import error_tables, event_lines, rejection_table

        tables = error_tables(self.scores, remarks(self.ensemble), explained(self.ensemble), self.forecast_scores)
        return rejection_table(self.logs.rejected), tables, "\n".join(event_lines(self.events))


def check_logs(logs: Any) -> AlignedLogs:
    """Logs, if `read` returned them; a path, say, raises ConfigError."""
    if not isinstance(logs, AlignedLogs):
        raise ConfigError(f"logs: found {logs!r}, expected what usvlearn.read returns: learn(read(PATH))")
    return logs
