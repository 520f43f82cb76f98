"""Two searches of hyperparameters whose settings are elements of one batch: on a grid, and along the gradient.

*Grid*: settings at equal distances on each scale; then, in further rounds, between the best one's neighbours.

*Gradient*: central differences of two widths, h and 2h of each scale, for each hyperparameter, beside the setting
itself: 4p + 1 elements of one batch (`docs/theory/ensemble.md#tuning`). Where the two differ, the error has a kink, and
a grid takes the rest of the budget. The descent is a damped quasi-Newton method (BFGS; Nocedal & Wright 2006, procedure
18.2) inside the ranges, with a bound on the step. The first step has the same length along each scale, whatever the
size of the gradient, because the effects of hyperparameters differ by orders of magnitude. A step is accepted only if
the error falls.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, check_choice
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, Setting

STARTS = ("default", "middle")
H = 1e-5  # h, of the scale
KINK = 0.1  # share of the largest slope by which the slopes over h and 2h may differ
FIRST = 1.0  # length of the first step, along each scale
GROW, SHRINK = 2.0, 0.5  # factors of the bound: after a step that reached it; after a failed step, of its length
FLAT = 0.01  # share of the largest slope; smaller slopes are raised to it in the first step
CURVATURE = 0.2  # least share of the expected curvature that an update may keep (the damping)
LEAST = 1e-7  # share of the error; no step is made whose expected gain is smaller


class Fitted(NamedTuple):
    """The result of tuning."""

    evaluations: list[Evaluation]  # the default first
    used: int  # evaluations used, without the default
    curve: Sequence[Mapping[str, float]] = ()  # of the descent, per pass: the MAE, m/s, and the hyperparameters


def counts(points: int, dimensions: int) -> list[int]:
    """The number of values of each dimension in a grid of at most `points` points, as equal as possible."""
    sizes = [max(1, math.floor(points ** (1 / dimensions) + 1e-9))] * dimensions
    for k in range(dimensions):
        if math.prod(sizes) // sizes[k] * (sizes[k] + 1) <= points:
            sizes[k] += 1
    return sizes


def product(values: Mapping[str, Sequence[float]]) -> list[Setting]:
    """All combinations of the values."""
    return [dict(zip(values, each, strict=True)) for each in itertools.product(*values.values())]


def grid(objective: Objective, parameters: Sequence[Hyperparameter], evaluations: int, rounds: int) -> Fitted:
    """Coarse, then refined around the best: a round is one pass with its share; no setting is evaluated twice."""
    default = {each.path: each.default for each in parameters}
    spans = [each.span for each in parameters]
    evaluated: list[Evaluation] = []
    for k in range(rounds):
        points = (evaluations - max(0, len(evaluated) - 1)) // (rounds - k)
        sizes = counts(points, len(parameters))
        # The ends of a refined range are the neighbours, which have been evaluated.
        steps = [(high - low) / (n + 1 if k else max(2, n - 1)) for (low, high), n in zip(spans, sizes, strict=True)]
        inner = [(low + s, high - s) if k or n == 1 else (low, high)
                 for (low, high), s, n in zip(spans, steps, sizes, strict=True)]  # fmt: skip
        values = {
            each.path: list(dict.fromkeys(each.spaced(*ends, n)))
            for each, ends, n in zip(parameters, inner, sizes, strict=True)
        }
        seen = {tuple(each.setting.values()) for each in evaluated} | {tuple(default.values())}
        settings = [setting for setting in product(values) if tuple(setting.values()) not in seen]
        evaluated += objective([default, *settings] if k == 0 else settings)
        best = min(evaluated, key=lambda each: each.mae).setting
        centres = [each.to_scale(best[each.path]) for each in parameters]
        spans = [
            (max(each.span[0], centre - step), min(each.span[1], centre + step))
            for each, centre, step in zip(parameters, centres, steps, strict=True)
        ]
    return Fitted(evaluated, len(evaluated) - 1)


def gradient(
    objective: Objective, parameters: Sequence[Hyperparameter], setting: Setting
) -> tuple[Evaluation, np.ndarray, bool]:
    """The evaluation of a setting, the gradient of its MAE over the scales, m/s, `(p,)`, and whether it has a kink.

    The error of the difference is of order h⁴, because both widths are combined; the digits of the MAE limit it to some
    1e-9 of the gradient.
    """
    beside = [
        {**setting, each.path: each.value(each.to_scale(setting[each.path]) + k * H)}
        for each in parameters for k in (-2, -1, 1, 2)
    ]  # fmt: skip
    evaluation, *others = objective([setting, *beside])
    with np.errstate(invalid="ignore"):  # a setting that diverges has no gradient
        far, near, ahead, further = np.array([each.mae for each in others]).reshape(-1, 4).T
        slope, wide = (ahead - near) / (2 * H), (further - far) / (4 * H)
        kink = bool((np.abs(slope - wide) > KINK * np.abs(slope).max()).any())
    return evaluation, (4 * slope - wide) / 3, kink


def descend(
    objective: Objective, parameters: Sequence[Hyperparameter], evaluations: int, start: str = "default"
) -> Fitted:
    """Follow the gradient from the default, or from the middle of the ranges, until the budget ends or no step is
    expected to help; the default is evaluated first, and the curve has a point for each pass.
    """
    check_choice("tuning.start", start, STARTS)
    cost = 4 * len(parameters) + 1
    if evaluations < 2 * cost:
        raise ConfigError(f"tuning.evaluations: found {evaluations}, expected {2 * cost} or more, the cost of learn")
    low, high = np.array([each.span for each in parameters]).T
    default = {each.path: each.default for each in parameters}
    seen: list[Evaluation] = []
    curve: list[dict[str, float]] = []

    def evaluated(place: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, bool]:
        """The evaluated place, rounded as it is saved; the error; the gradient; whether it has a kink."""
        setting = {each.path: each.from_scale(x) for each, x in zip(parameters, place.tolist(), strict=True)}
        if not seen and setting != default:
            seen.extend(objective([default]))
        evaluation, slope, kink = gradient(objective, parameters, setting)
        seen.append(evaluation)
        if finite := bool(np.isfinite(slope).all()):
            curve.append({"loss": evaluation.mae, **setting})
        place = np.array([each.to_scale(setting[each.path]) for each in parameters])
        return place, evaluation.mae if finite else math.inf, slope, kink

    given = [sum(each.span) / 2 if start == "middle" else each.to_scale(each.default) for each in parameters]
    place, error, slope, kink = evaluated(np.clip(given, low, high))
    curvature = np.diag(np.maximum(np.abs(slope), FLAT * np.abs(slope).max())) / FIRST
    passes, bound = 1, FIRST
    while (passes + 1) * cost <= evaluations and error < math.inf and not kink:
        # A parameter that would leave its range stays at the end of the range.
        free = ~(((place <= low) & (slope > 0)) | ((place >= high) & (slope < 0))) & (np.diag(curvature) > 0)
        step = np.zeros_like(place)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], -slope[free])
        step = step * min(1.0, bound / max(np.abs(step).max(), 1e-300))
        step = np.clip(place + step, low, high) - place
        promise = -float(slope @ step + step @ curvature @ step / 2)
        if not promise > LEAST * error:
            break
        tried, tried_error, tried_slope, kink = evaluated(place + step)
        passes += 1
        step = tried - place
        if tried_error < math.inf and step.any():
            curvature = updated(curvature, step, tried_slope - slope)
        longest = float(np.abs(step).max())
        if tried_error < error:
            place, error, slope = tried, tried_error, tried_slope
            bound *= GROW if longest > 0.99 * bound else 1.0
        else:
            bound = SHRINK * longest
    used = passes * cost
    if kink and evaluations > used:
        warnings.warn("learn: the error has a kink here: a grid takes the rest of the evaluations", stacklevel=2)
        rest = grid(objective, parameters, evaluations - used, 1)
        seen, used = [*seen, *rest.evaluations[1:]], used + rest.used
    return Fitted(seen, used, curve)


def updated(curvature: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The damped BFGS update of a second derivative, `(p, p)`; it stays positive where the error is not convex."""
    expected = curvature @ step
    whole, seen = step @ expected, step @ change
    if seen < CURVATURE * whole:
        share = (1 - CURVATURE) * whole / (whole - seen)
        change = share * change + (1 - share) * expected
    return curvature - np.outer(expected, expected) / whole + np.outer(change, change) / (step @ change)
