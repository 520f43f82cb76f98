"""How far the commands moved within a horizon: the three groups by which intervals of forecasts are judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Sample, masks
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import LITTLE, MUCH

GROUPS = ("stay", "move", "move_much")


def groups_of(samples: Sample, horizons: Sequence[float], surge_limit: float = PLAUSIBLE) -> np.ndarray:
    """The group of a forecast that is due at each step: 0, 1 or 2, `(time, boats, horizons)`.

    Args:
        samples: arrays `(time, boats)`.
        horizons: s.
        surge_limit: m/s, of the ensemble.

    >>> from usvlearn.core.samples import Inputs
    >>> t, held = np.ones((4, 1)), np.array([[0.0], [0.1], [0.1], [0.9]])
    >>> samples = Sample(Inputs(held, held, 0 * t, 0 * t, 0.4 * t), t, t > 0, t > 0)
    >>> groups_of(samples, [0.4, 0.8])[..., 0].ravel().tolist(), groups_of(samples, [0.8])[3].item()
    ([0, 1, 0, 2], 2)
    """
    steps, inputs = masks(samples, surge_limit).steps, samples.inputs
    time = np.where(steps, inputs.dt, 0.0).cumsum(0)
    mean = (inputs.command_left + inputs.command_right) / 2
    found = np.zeros((*mean.shape, len(horizons)), np.int8)
    for element in range(mean.shape[1]):
        own = steps[:, element]
        least = _doubled(np.where(own, mean[:, element], np.inf), np.minimum)
        most = _doubled(np.where(own, mean[:, element], -np.inf), np.maximum)
        for j, horizon in enumerate(horizons):
            half = np.where(own, samples.inputs.dt[:, element], 0.0) / 2
            origin = np.searchsorted(time[:, element], time[:, element] - horizon - half)
            origin = np.minimum(origin, np.arange(len(time)))
            low, high = _over(least, origin, np.minimum), _over(most, origin, np.maximum)
            moved = np.where(np.isfinite(high - low), high - low, 0.0)
            found[:, element, j] = (moved >= LITTLE).astype(np.int8) + (moved > MUCH)
    return found


def _doubled(x: np.ndarray, f: np.ufunc) -> list[np.ndarray]:
    """The extreme values of the 2ʲ numbers that end at each place, for each j; of fewer at the beginning."""
    found, length = [x], 1
    while length < len(x):
        last = found[-1]
        found.append(np.concatenate([last[:length], f(last[length:], last[:-length])]))
        length *= 2
    return found


def _over(doubled: Sequence[np.ndarray], first: np.ndarray, f: np.ufunc) -> np.ndarray:
    """The extreme values from the places `first` to each place, both included."""
    last = np.arange(len(first))
    level = np.frexp(last - first + 1)[1] - 1  # the largest power of two that fits
    table = np.stack(doubled)
    return f(table[level, last], table[level, np.minimum(first + (1 << level) - 1, last)])
