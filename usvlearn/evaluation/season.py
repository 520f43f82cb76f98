"""The data of a season for each boat: its runs, their predictions, and the checkpoints that were saved during them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, Masks, Run, Sample, masks, tree_map
from usvlearn.errors import ConfigError, MissingExtraError, did_you_mean


def measured(samples: Sample, surge_limit: float) -> np.ndarray:
    """The measured speed where a step is learned from and scored, m/s, else NaN."""
    return np.where(masks(samples, surge_limit).learns, samples.surge, np.nan)


class SeasonRun(NamedTuple):
    """One run of one boat."""

    name: str
    key: str  # a sha256 of the samples
    samples: Sample  # leaves (time,), NumPy
    published: dict[str, np.ndarray]  # (time, ...) online predictions (`usvlearn.runs.prediction_files`), or empty
    time: np.ndarray  # (time,) s
    position: np.ndarray | None = None  # (time, 2) m north and east, if the log has it
    surge_limit: float = PLAUSIBLE  # m/s, of the ensemble that is judged

    @property
    def masks(self) -> Masks:
        """Which steps are made, count and start a segment, and which speeds are known, `(time,)`."""
        return masks(self.samples, self.surge_limit)

    @property
    def measured(self) -> np.ndarray:
        """The speed where the step counts, m/s, else NaN, `(time,)`."""
        return measured(self.samples, self.surge_limit)

    @property
    def steps(self) -> np.ndarray:
        """Which steps count, `(time,)` bool."""
        return self.masks.learns

    @property
    def spacing(self) -> float:
        """The median length of a step, s; 0 of a run without steps."""
        steps = self.samples.inputs.dt[self.samples.inputs.dt > 0]
        return float(np.median(steps)) if len(steps) else 0.0


class Season(NamedTuple):
    """One boat over all its runs."""

    boat: str
    runs: tuple[SeasonRun, ...]
    state: Any  # the checkpoints in the order in which they were saved, leaves (checkpoints, ...)
    paths: tuple[Path, ...]  # of the checkpoints
    saved_in: np.ndarray  # (checkpoints,) index of the run in which each was saved, -1 if it is none of `runs`
    hours: np.ndarray  # (checkpoints,) h on the water until the checkpoint was saved

    @property
    def replayed(self) -> tuple[Fleet, list[tuple[int, int, dict[str, np.ndarray]]]]:
        """The runs with online predictions as a fleet of one boat, and what was published of each."""
        runs = [run for run in self.runs if run.published]
        wide = [tree_map(lambda x: x[:, None], run.samples) for run in runs]
        padded = tuple(
            Run(run.time[:, None], samples, (run.name,), (len(run.time),))
            for run, samples in zip(runs, wide, strict=True)
        )
        published = [(k, 0, {key: x[:, None] for key, x in run.published.items()}) for k, run in enumerate(runs)]
        return Fleet((self.boat,), padded, {}), published

    @property
    def later(self) -> np.ndarray:
        """Which runs a checkpoint has not learned from, bool `(checkpoints, runs)`: those after its own, else all."""
        return self.saved_in[:, None] < np.arange(len(self.runs))

    def checkpoint_before(self, run: int) -> tuple[int, bool]:
        """The newest checkpoint that has not learned from a run, and False; else the first saved since, and True."""
        before = np.flatnonzero(self.saved_in < run)
        return (int(before[-1]), False) if len(before) else (int(np.flatnonzero(self.saved_in >= run)[0]), True)

    @property
    def others(self) -> np.ndarray:
        """Which runs a checkpoint was not saved in, bool `(checkpoints, runs)`."""
        return self.saved_in[:, None] != np.arange(len(self.runs))


@dataclass(frozen=True)
class Predictions:
    """Predictions of the speed over one run of one boat, each made before that speed was used.

    >>> time, x = np.array([0.0, 0.4]), np.array([1.0, 1.1])
    >>> predictions = Predictions("heron", "001", time, x, {"ensemble": x}, {"ensemble": np.array([np.inf, 0.25])})
    >>> low, high = predictions.interval("ensemble")
    >>> round(float(low[1]), 2), round(float(high[1]), 2)
    (0.85, 1.35)
    """

    boat: str  # its name
    run: str  # its name, within the boat
    time: np.ndarray  # (time,) s since its first step
    measured: np.ndarray  # (time,) m/s, NaN where it was not measured
    predicted: dict[str, np.ndarray]  # member or combiner -> (time,) m/s, NaN where no step was made
    halfwidth: dict[str, np.ndarray]  # (time,) m/s, of its interval; infinite before ten errors; {} in a simulation

    def interval(self, name: str = "ensemble") -> tuple[np.ndarray, np.ndarray]:
        """The 90 % interval of a member or combiner.

        Args:
            name: of the member or combiner.

        Returns:
            The lower and the upper end, m/s, `(time,)` each.

        Raises:
            ConfigError: there is no such name.
        """
        if name not in self.halfwidth:
            hint = did_you_mean(name, self.halfwidth)
            raise ConfigError(f"interval: found {name!r}, expected one of {', '.join(self.halfwidth) or 'none'}{hint}")
        return self.predicted[name] - self.halfwidth[name], self.predicted[name] + self.halfwidth[name]

    def to_pandas(self) -> Any:
        """The predictions as a table.

        Returns:
            A `pandas.DataFrame`, one row a step: `time`, s, `measured`, then each member and combiner and the
            half-width of its interval, `NAME_halfwidth`, m/s.

        Raises:
            MissingExtraError: pandas is not installed.

        >>> Predictions("heron", "001", np.zeros(1), np.ones(1), {}, {}).to_pandas()  # doctest: +SKIP
        """
        widths = {f"{name}_halfwidth": each for name, each in self.halfwidth.items()}
        return pandas().DataFrame({"time": self.time, "measured": self.measured, **self.predicted, **widths})


def pandas() -> Any:
    """The package, or a MissingExtraError."""
    try:
        import pandas  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("pandas", "tables", "a table of pandas") from error
    return pandas


def predictions_of(
    fleet: Fleet, names: Sequence[str], published: Sequence[Mapping[str, np.ndarray]]
) -> tuple[Predictions, ...]:
    """Split what was published of a fleet's runs, arrays `(time, boats, names)`, by run and boat."""
    predictions = []
    for index, run in enumerate(fleet.runs):
        for element, boat in enumerate(fleet.boats):
            if n := run.lengths[element]:
                by_name = [
                    dict(zip(names, published[index][key][:n, element].T, strict=True))
                    if key in published[index]
                    else {}
                    for key in ("predictions", "halfwidths")
                ]
                measured = measured_surge(samples_of(run.samples, n, element))
                predictions.append(Predictions(boat, run.names[element], run.time[:n, element], measured, *by_name))
    return tuple(predictions)


def samples_of(samples: Sample, steps: int, element: int) -> Sample:
    return tree_map(lambda leaf: leaf[:steps, element], samples)


def measured_surge(samples: Sample) -> np.ndarray:
    """The speed, m/s, NaN where it was not measured."""
    return np.where(samples.measured, samples.surge, np.nan)
