"""Search of hyperparameters on a grid, hundreds of settings in one pass: first coarse, then refined around the best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, Setting


def counts(points: int, dimensions: int) -> list[int]:
    """The number of values of each dimension in a grid of at most `points` points, as equal as possible.

    >>> counts(32, 2), counts(7, 3)
    ([6, 5], [2, 2, 1])
    """
    found = [max(1, math.floor(points ** (1 / dimensions) + 1e-9))] * dimensions
    for k in range(dimensions):
        if math.prod(found) // found[k] * (found[k] + 1) <= points:
            found[k] += 1
    return found


def product(values: Mapping[str, Sequence[float]]) -> list[Setting]:
    """All combinations of the values.

    >>> product({"gain": [1.0, 2.0], "memory": [5.0]})
    [{'gain': 1.0, 'memory': 5.0}, {'gain': 2.0, 'memory': 5.0}]
    """
    return [dict(zip(values, each, strict=True)) for each in itertools.product(*values.values())]


def grid(
    objective: Objective, parameters: Sequence[Hyperparameter], evaluations: int, rounds: int
) -> tuple[list[Evaluation], int]:
    """Evaluate settings at equal distances on each scale; then, in further rounds, between the best one's neighbours.

    A round uses its share of the remaining evaluations, and is one pass. No setting is evaluated twice.

    Returns:
        All evaluations, the default first; and their number without it.
    """
    default = {each.path: each.default for each in parameters}
    spans = [each.span for each in parameters]
    found: list[Evaluation] = []
    for k in range(rounds):
        points = (evaluations - max(0, len(found) - 1)) // (rounds - k)
        sizes = counts(points, len(parameters))
        # The ends of a refined range are the neighbours, which have been evaluated.
        steps = [(high - low) / (n + 1 if k else max(2, n - 1)) for (low, high), n in zip(spans, sizes, strict=True)]
        inner = [(low + s, high - s) if k or n == 1 else (low, high)
                 for (low, high), s, n in zip(spans, steps, sizes, strict=True)]  # fmt: skip
        values = {
            each.path: list(dict.fromkeys(each.spaced(*ends, n)))
            for each, ends, n in zip(parameters, inner, sizes, strict=True)
        }
        seen = [each.setting for each in found]
        settings = [setting for setting in product(values) if setting not in seen and setting != default]
        found += objective([default, *settings] if k == 0 else settings)
        best = min(found, key=lambda each: each.mae).setting
        centres = [each.to_scale(best[each.path]) for each in parameters]
        spans = [
            (max(each.span[0], centre - step), min(each.span[1], centre + step))
            for each, centre, step in zip(parameters, centres, steps, strict=True)
        ]
    return found, len(found) - 1
