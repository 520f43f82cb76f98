"""Relations of two channels of a log: slope, correlation and lag, each with its certainty.

A series is a pair (time, value), s and SI units, in any order, with gaps, NaN and stamps of its own. Two series are
compared by their means over bins of equal length; a bin in which one of them has a gap is left out. The equations (1)
to (3) are those of `docs/theory/model.md#two-channels`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import OUTAGE, Series, bin_edges, bin_means, bin_rates, cleaned, clipped

FEWEST = 12  # bins, below which nothing is concluded
FEW_LAGS = 64  # that are summed one by one; more by Fourier transforms
REACH = 60.0  # s, lags of an autocorrelation that are summed
NO_LAG = (0.0, 0.0)
SURE, CLOSE = 4.0, 0.9  # standard errors, and correlation, of a relation that is no chance
PUSHES, SIGNED, RISES = -0.1, 0.03, 0.15  # of full scale; of the greatest speed
ENOUGH, MOSTLY = 2, 0.5  # stretches; share of the time, from which rather the sign of the commands is wrong


class Relation(NamedTuple):
    """How a series y follows a series x; NaN where there is too little evidence."""

    slope: float  # dy/dx by (2), in their units
    correlation: float  # by (1), at the lag where its size is greatest
    error: float  # by (3): of the correlation, if the two were unrelated
    lag: float  # s, by which y follows x
    seconds: float  # in which both are known

    @property
    def certainty(self) -> float:
        """The correlation in standard errors; beyond ±4 it is no chance."""
        return self.correlation / self.error if self.error > 0 else math.nan

    def is_sure(self, seconds: float) -> bool:
        """Whether it is no chance: by its certainty, or as a close one over so many seconds."""
        close = abs(self.correlation) >= CLOSE and self.seconds >= seconds
        return self.seconds > 0 and (close or abs(self.certainty) >= SURE)


class Offset(NamedTuple):
    """By how much one angle differs from another, or from its mirror image."""

    offset: float  # rad: one - sign * other, the circular mean
    concentration: float  # length of the mean vector: 1 if the difference is constant, 0 if it is random
    sign: float  # -1: the two angles count in opposite directions
    rival: float  # concentration with the other sign; near the first one, the sign is not known
    seconds: float


NOTHING = Relation(math.nan, math.nan, math.nan, math.nan, 0.0)


def in_series(runs: Iterable[Mapping[str, Series]]) -> dict[str, Series]:
    """Runs one behind the other, each channel as one series; `OUTAGE` seconds lie between two runs."""
    parts: dict[str, list[Series]] = {}
    end = 0.0
    for run in runs:
        nonempty = {name: series for name, given in run.items() if len((series := cleaned(given))[0])}
        first = min((time[0] for time, _ in nonempty.values()), default=0.0)
        last = max((time[-1] for time, _ in nonempty.values()), default=0.0)
        for name, (time, value) in nonempty.items():
            parts.setdefault(name, []).append((time - first + end, value))
        end += last - first + OUTAGE
    return {name: (np.concatenate([t for t, _ in s]), np.concatenate([v for _, v in s])) for name, s in parts.items()}


def heading_rate(heading: Series) -> Series:
    """The rate of turn between two headings, rad/s, at the time between them; that of a wrap is left out.

    A jump by more than half the range of all headings is a wrap. Their unit need not be known for that.
    """
    time, angle = cleaned(heading)
    turned, passed = np.diff(angle), np.diff(time)
    valid = (np.abs(turned) <= np.ptp(angle) / 2) & (passed > 0) if len(angle) else passed > 0
    return (time[:-1] + passed / 2)[valid], turned[valid] / passed[valid]


def rate_slope(
    heading: Series, yaw_rate: Series, lags: tuple[float, float] = (-2.0, 2.0), step: float = 0.5
) -> Relation:
    """The yaw rate against the derivative of the heading: 1 where both have the same unit and sense.

    A slope of 57 means rad/s read where the heading is in degrees, or the reverse; a negative one a reversed sense.
    """
    edges = bin_edges(step, heading, yaw_rate)
    rate, turned = clipped(bin_means(yaw_rate, edges)), clipped(bin_rates(heading, edges, wraps=True))
    return relate(turned, rate, step, lags)


def side_sign(
    left: Series, right: Series, yaw_rate: Series, lags: tuple[float, float] = (0.0, 5.0), step: float = 0.5
) -> Relation:
    """The yaw rate against the difference of the commands, left − right, which are held until the next one.

    A stronger left thruster turns the bow to starboard, which is a positive yaw rate.
    """
    edges = bin_edges(step, yaw_rate)
    return relate(
        bin_means(left, edges, held=True) - bin_means(right, edges, held=True),
        clipped(bin_means(yaw_rate, edges)),
        step,
        lags,
    )


def speed_on_thrust(
    left: Series, right: Series, speed: Series, lags: tuple[float, float] = (0.0, 20.0), step: float = 0.5
) -> Relation:
    """The speed against the mean of both commands, and the lag that fits best: delays and the boat's inertia."""
    edges = bin_edges(step, speed)
    both = bin_means(left, edges, held=True) + bin_means(right, edges, held=True)
    return relate(both / 2, clipped(bin_means(speed, edges)), step, lags)


def angle_offset(one: Series, other: Series, step: float = 1.0) -> Offset:
    """By how much a heading differs from another one, or from the course over ground where the boat moves, rad."""
    edges = bin_edges(step, one, other)
    first, second = (bin_means((time, np.exp(1j * angle)), edges) for time, angle in map(cleaned, (one, other)))
    with np.errstate(invalid="ignore"):
        first, second = first / np.abs(first), second / np.abs(second)
    known = np.isfinite(first) & np.isfinite(second)
    if known.sum() < FEWEST:
        return Offset(math.nan, math.nan, math.nan, math.nan, 0.0)
    first, second = first[known], second[known]
    along, against = np.mean(first * second.conj()), np.mean(first * second)
    mean, sign, rival = (along, 1.0, against) if abs(along) >= abs(against) else (against, -1.0, along)
    return Offset(float(np.angle(mean)), float(abs(mean)), sign, float(abs(rival)), float(step * known.sum()))


def residual(values: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """What is left of a series after linear regression on another one."""
    known = np.isfinite(values) & np.isfinite(beside)
    if known.sum() < FEWEST:
        return np.full_like(values, np.nan)
    x, y = beside - beside[known].mean(), values - values[known].mean()
    spread = x[known] @ x[known]
    return y - (x[known] @ y[known] / spread if spread > 0 else 0.0) * x


def _fit(left: np.ndarray, right: np.ndarray, response: np.ndarray, lag: float, step: float) -> float:
    """The share of the response that both sides together explain at a lag of 0 or more, s."""
    shift = round(lag / step)
    size = len(response) - shift
    rows = np.stack([left[:size], right[:size], response[shift:]])
    rows = rows[:, np.isfinite(rows).all(0)]
    if rows.shape[1] < FEWEST:
        return 0.0
    rows = rows - rows.mean(1, keepdims=True)
    left_over = rows[2] - np.linalg.lstsq(rows[:2].T, rows[2], rcond=None)[0] @ rows[:2]
    return 1 - float(left_over @ left_over) / max(float(rows[2] @ rows[2]), 1e-300)


def relate(x: np.ndarray, y: np.ndarray, step: float, lags: tuple[float, float]) -> Relation:
    """Equations (1) to (3) for means over the same bins of `step` s, at the lag in `lags`, s, where |r| is greatest.

    `x` and `y` are `(bins,)`, NaN where unknown.
    """
    known_x, known_y = np.isfinite(x), np.isfinite(y)
    if min(known_x.sum(), known_y.sum()) < FEWEST:
        return NOTHING
    x, y = np.where(known_x, x - x[known_x].mean(), 0.0), np.where(known_y, y - y[known_y].mean(), 0.0)
    scale_x, scale_y = (math.sqrt(float(each @ each) / known.sum()) for each, known in ((x, known_x), (y, known_y)))
    if not (scale_x > 1e-9 and scale_y > 1e-9):
        return NOTHING
    x, y = x / scale_x, y / scale_y
    low, high = math.floor(lags[0] / step), math.ceil(lags[1] / step)
    n, sx, sxx, sy, syy, sxy = _sums(np.stack([known_x, x, x * x]), np.stack([known_y, y, y * y]), low, high)
    counts = np.maximum(n, 1)
    within_x, within_y = np.maximum(sxx - sx**2 / counts, 0), np.maximum(syy - sy**2 / counts, 0)
    spread = np.sqrt(within_x * within_y)
    usable = (n >= max(FEWEST, n.max() / 2)) & (spread > 1e-9 * counts)
    if not usable.any():
        return NOTHING
    r = np.where(usable, (sxy - sx * sy / counts) / np.where(usable, spread, 1.0), 0.0)
    at = int(np.argmax(np.abs(r)))
    slope = math.copysign(math.sqrt(within_y[at] / within_x[at]) * scale_y / scale_x, r[at])
    error = math.sqrt(_dependence(x, y, step) / n[at])
    return Relation(float(slope), float(r[at]), error, float((low + at) * step), float(n[at] * step))


def relate_sides(
    left: np.ndarray, right: np.ndarray, response: np.ndarray, step: float, lags: tuple[float, float]
) -> tuple[Relation, Relation]:
    """The response, a yaw rate or a speed, against the command of each side, at an equal command of the other one.

    The relation is that of what is left of both after regression on the other side (partial correlation). A yaw rate
    rises with the left command and falls with the right one; a speed rises with both. All are as of `relate`.
    """
    relations = [relate(side, response, step, lags) for side in (left, right)]
    best = max(
        (each.lag for each in relations if each.seconds),
        key=lambda lag: _fit(left, right, response, lag, step),
        default=0.0,
    )
    shift = round(best / step)
    if shift > 0:
        response = np.concatenate([response[shift:], np.full(shift, np.nan)])
    one, other = (
        relate(residual(side, beside), residual(response, beside), step, NO_LAG)._replace(lag=best)
        for side, beside in ((left, right), (right, left))
    )
    return one, other


def _sums(of_x: np.ndarray, of_y: np.ndarray, low: int, high: int) -> np.ndarray:
    """Sums over the bins known in both, at each lag: their number, x, x², y, y² and xy, `(6, lags)`.

    Of x and of y there are what is known (0 or 1), the values, 0 where unknown, and their squares, `(3, bins)`.
    """
    bins = of_x.shape[1]
    if high - low < FEW_LAGS:
        sums = np.zeros((6, high - low + 1))
        for k, lag in enumerate(range(low, high + 1)):
            size = bins - abs(lag)
            if size > 0:
                product = of_x[:, max(-lag, 0) :][:, :size] @ of_y[:, max(lag, 0) :][:, :size].T
                sums[:, k] = product[[0, 1, 2, 0, 0, 1], [0, 0, 0, 1, 2, 1]]
        return sums
    size = 2 ** math.ceil(math.log2(bins + max(abs(low), abs(high)) + 1))
    spectra_x, spectra_y = np.fft.rfft(of_x, size).conj(), np.fft.rfft(of_y, size)
    products = spectra_x[[0, 1, 2, 0, 0, 1]] * spectra_y[[0, 0, 0, 1, 2, 1]]
    sums = np.fft.irfft(products, size)[:, np.arange(low, high + 1) % size]
    sums[0] = np.round(sums[0])
    return sums


def _dependence(x: np.ndarray, y: np.ndarray, step: float) -> float:
    """Σ_k ρ_x(k) ρ_y(k) of (3), 1 or more; those at lags beyond `REACH` are noise, and left out."""
    reach = max(1, min(len(x) // 4, round(REACH / step)))
    size = 2 ** math.ceil(math.log2(len(x) + reach + 1))
    auto_x, auto_y = np.fft.irfft(np.abs(np.fft.rfft(np.stack([x, y]), size)) ** 2, size)[:, :reach]
    rho = auto_x / auto_x[0] * (auto_y / auto_y[0])
    return max(1.0, float(2 * rho.sum() - rho[0]))


def without_sign(left: np.ndarray, right: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Where a speed, m/s, lacks its sign while a boat goes astern, as a speed over ground does, `(n,)` bool.

    A speed with a sign falls below zero while both commands push astern for long. One without a sign falls to zero and
    rises again. That of a boat that only brakes falls all the time. Speed and commands, shares of full scale, are in
    the order of time; NaN where unknown.
    """
    none, known = np.zeros(len(speed), bool), speed[np.isfinite(speed)]
    if not len(known) or (fastest := float(np.quantile(np.abs(known), 0.995))) <= 0:
        return none
    back = (left < PUSHES) & (right < PUSHES)
    if float(np.quantile(known, 0.005)) < -SIGNED * fastest or back.mean() > MOSTLY:
        return none
    edges = np.flatnonzero(np.diff(np.concatenate([[False], back, [False]]).astype(np.int8)))
    unsigned, stretches = none.copy(), 0
    for first, last in edges.reshape(-1, 2):
        part = speed[first:last]
        if not np.isfinite(part).any():
            continue
        low = int(np.nanargmin(part))
        if np.nanmax(part[low:]) - part[low] > RISES * fastest and part[low] < 0.5 * fastest:
            unsigned[first + low : last], stretches = True, stretches + 1
    return unsigned if stretches >= ENOUGH else none
