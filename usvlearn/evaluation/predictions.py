"""Predictions of a run of one boat, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from usvlearn.core.samples import Fleet, Sample, tree_map
from usvlearn.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Predictions:
    """Predictions of the speed over one run of one boat, each made before that speed was used.

    >>> time, x = np.array([0.0, 0.4]), np.array([1.0, 1.1])
    >>> found = Predictions("heron", "001", time, x, {"ensemble": x}, {"ensemble": np.array([np.inf, 0.25])})
    >>> low, high = found.interval("ensemble")
    >>> round(float(low[1]), 2), round(float(high[1]), 2)
    (0.85, 1.35)
    """

    boat: str  # its name
    run: str  # its name, within the boat
    time: np.ndarray  # (time,) s since its first step
    measured: np.ndarray  # (time,) m/s, NaN where it was not measured
    predicted: dict[str, np.ndarray]  # member or combiner -> (time,) m/s, NaN where no step was made
    halfwidth: dict[
        str, np.ndarray
    ]  # (time,) m/s, of its interval; infinite before ten measurements; empty in a simulation

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


def predictions_of(
    fleet: Fleet, names: Sequence[str], published: Sequence[Mapping[str, np.ndarray]]
) -> tuple[Predictions, ...]:
    """Split what was published of a fleet's runs, arrays `(time, boats, names)`, by run and boat."""
    found = []
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
                found.append(Predictions(boat, run.names[element], run.time[:n, element], measured, *by_name))
    return tuple(found)


def samples_of(samples: Sample, steps: int, element: int) -> Sample:
    return tree_map(lambda leaf: leaf[:steps, element], samples)


def measured_surge(samples: Sample) -> np.ndarray:
    """The speed, m/s, NaN where it was not measured."""
    return np.where(samples.measured, samples.surge, np.nan)
