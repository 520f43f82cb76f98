"""Compares a position with the velocity, the speed, the sway or the heading, by `channels.correlations`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from usvlearn.logs.channels.bins import Series, bin_directions, bin_edges, bin_means, bin_rates, cleaned, clipped, gaps
from usvlearn.logs.channels.correlations import FEWEST, NO_LAG, Relation, relate, residual

STRAIGHT = 0.9, 0.7  # share of the way by which a boat that turns comes on, at least, where its speed is compared
OFTEN = 0.3  # share of the bins from which the first of them is taken
FAST = 0.3  # share of the greatest speed from which a ratio of speeds is taken
LEG, BLOCKS, AHEAD = 2.0, 6, 40  # s, of the bins of a compass; blocks; bins
ALIKE, ASTERN = 0.6, math.cos(math.radians(165))  # of the mean direction of the course from the heading, if it is known
MOVES, ONE_WAY = 0.3, 0.9  # of the greatest speed; length of the mean heading, beyond which there is one course alone
OFF, SURE, EXACT = math.radians(6), 4.0, math.radians(2.5)  # errors that are told; in, and of standard errors
FEWEST_LEGS = 120
MINUTE, IMAGE, BETTER = 60.0, 0.9, 5.0  # s, correlation and ratio of squares of a mirror image


class Motion(NamedTuple):
    """How the rate of a position follows a measured velocity, both as complex numbers, north + i east.

    NaN where there is too little evidence. Values of `along` and `against` are correlation coefficients: their size is
    at most 1, and their angle is that by which the rate is turned from the velocity, or from its mirror image.
    """

    along: complex  # with the velocity
    against: complex  # with its complex conjugate: one axis is reversed, or both are interchanged
    scale: float  # standard deviation of the rate over that of the velocity
    spread: float  # m/s, standard deviation of the velocity
    seconds: float

    @property
    def is_mirrored(self) -> bool:
        """Whether the mirror image fits, and leaves a fifth of the squares that the velocity itself leaves, or less."""
        rest, of_image = 1 - abs(self.along) ** 2, 1 - abs(self.against) ** 2
        return self.seconds >= MINUTE and abs(self.against) > IMAGE and rest > BETTER * of_image


def speed_on_positions(
    north: Series, east: Series, speed: Series, heading: Series | None = None, step: float = 5.0
) -> Relation:
    """The size of the speed against the rate of position; the slope is the median of their ratio.

    Both are changes between the means of neighbouring bins, in which noise averages out. A boat that turns goes farther
    than its place moves: with a heading, rad, of any zero and sense, the rate is that along its way, if the speed
    follows this one better. Bins in which it hardly turns are preferred: in a current its way does not turn as its bow.
    """
    edges = bin_edges(step, north, east, speed)[:-1]  # the last bin may end later than a series
    time, value = cleaned(speed)
    rates = [np.abs(_moved(north, edges) + 1j * _moved(east, edges))]
    size = clipped(np.abs(_moved(_sum((time, np.abs(value))), edges)))
    if heading is not None:
        stamps, angle = cleaned(heading)
        straight = np.abs(_moved(_sum((stamps, np.exp(1j * angle))), edges))
        least = STRAIGHT[0] if (straight > STRAIGHT[0]).sum() > OFTEN * len(straight) else STRAIGHT[1]
        rates.append(rates[0] / np.where(straight > least, straight, np.nan))
    relations = [_ratio(clipped(each), size, step) for each in rates]
    return max(relations, key=lambda each: np.nan_to_num(each.correlation, nan=-1.0))


def _sum(series: Series) -> Series:
    """The integral of a series from its first stamp on."""
    time, value = series
    return time, np.append(0.0, np.cumsum(np.diff(time) * (value[:-1] + value[1:]) / 2))[: len(time)]


def _moved(series: Series, edges: np.ndarray) -> np.ndarray:
    """The rate of change from the mean of one bin to that of the next one, `(bins - 1,)`; NaN beside a gap."""
    means = np.where(gaps(cleaned(series)[0], edges, 0.0), np.nan, bin_means(series, edges))
    return np.diff(means) / np.diff(edges[:-1])


def _ratio(rate: np.ndarray, size: np.ndarray, step: float) -> Relation:
    """The relation, with the median of the ratios as its slope; noise across the way makes a rate greater."""
    relation = relate(rate, size, step, NO_LAG)
    known = np.isfinite(rate) & np.isfinite(size)
    if not relation.seconds or not (fast := known & (rate > FAST * np.max(rate[known], initial=0.0))).any():
        return relation
    rate, size = rate[fast], size[fast]
    noise = 1.48 * np.median(np.abs(rate - size / max(np.median(size / rate), 1e-9)))  # m/s
    return relation._replace(slope=float(np.median(size / np.maximum(rate - noise**2 / rate / 2, rate / 2))))


def position_on_velocity(position: tuple[Series, Series], velocity: tuple[Series, Series], step: float = 5.0) -> Motion:
    """The rate of a position against a velocity over ground, each north and east."""
    edges = bin_edges(step, *position, *velocity)
    rate = _plane([bin_rates(series, edges) for series in position])
    speed = _plane([bin_means(series, edges) for series in velocity])
    known = np.isfinite(rate) & np.isfinite(speed)
    count = int(known.sum())
    if count < FEWEST:
        return Motion(math.nan, math.nan, math.nan, math.nan, 0.0)
    rate, speed = (each[known] - each[known].mean() for each in (rate, speed))
    of_rate, of_speed = (math.sqrt(float(np.mean(np.abs(each) ** 2))) for each in (rate, speed))
    both = max(of_rate * of_speed, 1e-12)
    along, against = (complex(np.mean(rate * each)) / both for each in (speed.conj(), speed))
    return Motion(along, against, of_rate / max(of_speed, 1e-12), of_speed, step * count)


def sway_on_positions(north: Series, east: Series, heading: Series, sway: Series, step: float = 2.0) -> Relation:
    """The sway against the rate of position across the hull, to starboard, at an equal rate along the hull.

    The slope is 1 where the sway is right, -1 where it counts to port. What a compass error adds to the rate across is
    a part of the rate along, and left out.
    """
    edges = bin_edges(step, north, east, heading, sway)
    along = bin_directions(heading, edges)
    with np.errstate(invalid="ignore"):
        along /= np.abs(along)
    rate = _plane([bin_rates(north, edges), bin_rates(east, edges)]) * along.conj()
    across, measured = (residual(each, rate.real) for each in (rate.imag, clipped(bin_means(sway, edges))))
    return relate(across, measured, step, NO_LAG)


def _plane(parts: list[np.ndarray]) -> np.ndarray:
    """Two components as complex numbers whose size is at most its `EXTREME` quantile."""
    size = np.hypot(*parts)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(size > 0, clipped(size) / size, 1.0)
    return share * (parts[0] + 1j * parts[1])


class Legs(NamedTuple):
    """What a boat did in bins of `LEG` s, `(bins,)`; NaN where it is not known."""

    over_ground: NDArray[np.complex128]  # velocity, north + i east, m/s
    along: NDArray[np.complex128]  # mean of exp(iψ) with its heading ψ
    ahead: np.ndarray  # speed, m/s
    turn: np.ndarray  # rad/s


def compass_error(legs: Legs) -> tuple[float, float] | None:
    """What has to be added to a heading, and its standard error, rad; None unless it is surely more than `OFF`."""
    error = offset(legs, AHEAD)
    return error if error and abs(error[0]) > max(OFF, SURE * error[1]) and error[1] < EXACT else None


def legs_on(north: Series, east: Series, heading: Series, speed: Series) -> Legs:
    """The same by positions."""
    edges = bin_edges(LEG, north, east, heading, speed)
    return legs_of(bin_rates(north, edges) + 1j * bin_rates(east, edges), heading, speed, edges)


def legs_of(over_ground: np.ndarray, heading: Series, speed: Series, edges: np.ndarray) -> Legs:
    """The same in bins in which the velocity over ground is known."""
    turn = bin_rates(heading, edges, wraps=True)
    return Legs(over_ground, bin_directions(heading, edges), bin_means(speed, edges), turn)


def offset(legs: Legs, fewest: int) -> tuple[float, float] | None:
    """What has to be added to a heading, and its standard error, rad; None with fewer bins, or on one course alone.

    The velocity over ground w, north + i east, is that through the water, turned by the error δ of the heading ψ, and a
    current c; in a turn r the hull drifts outwards (None if this explains less than half of w):

        w = u (a + b r) exp(i ψ) + c,    δ = arg a

    a, b and c are complex, and fitted by least squares over bins in which the boat moves ahead, on several courses. The
    error of δ is that of a jackknife over blocks of the log, so that a current that changes makes δ uncertain.
    """
    over_ground, along, ahead, turn = legs
    fastest = np.nanquantile(np.abs(ahead), 0.98) if np.isfinite(ahead).any() else 0.0
    with np.errstate(invalid="ignore"):
        fast = (ahead > MOVES * fastest) & np.isfinite(over_ground * along * turn)
        off = np.mean((over_ground * along.conj() / np.abs(over_ground))[fast]) if fast.any() else 0.0
    whole = float(np.angle(off)) if abs(off) > ALIKE and off.real > ASTERN * abs(off) else 0.0
    for _ in range(3):  # each leaves out bins of a boat that goes astern, by the error that is known so far
        known = fast & ((over_ground * along.conj() * np.exp(-1j * whole)).real > 0)
        if known.sum() < fewest or abs(np.mean(along[known])) > ONE_WAY:
            return None
        push, goal = ahead[known] * along[known], over_ground[known]
        rows = np.stack([push, push * turn[known], np.ones(len(push))], 1)
        whole = float(np.angle(np.linalg.lstsq(rows, goal)[0][0]))
    fits = jackknife(rows, goal)
    if np.var(goal - rows @ fits[0]) > np.var(goal) / 2:
        return None
    return whole, math.sqrt((BLOCKS - 1) * float(np.var(np.angle(fits[1:, 0] * np.exp(-1j * whole)))))


def jackknife(rows: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Coefficients by least squares, of all rows and without each of `BLOCKS` blocks, `(1 + BLOCKS, columns)`."""
    block = np.arange(len(goal)) * BLOCKS // len(goal)
    return np.stack([np.linalg.lstsq(rows[block != k], goal[block != k])[0] for k in range(-1, BLOCKS)])


def deviations(legs: Legs) -> list[tuple[float, float]]:
    """The errors of a heading that change with it once, and twice, in a turn, and their standard errors, rad.

    An error A sin(ψ + φ) of a compass adds u times as much to the velocity across the heading, with the speed u; a
    current c adds Im(c exp(−iψ)). Both are fitted, beside the drift in a turn; there are none in too few bins.
    """
    over_ground, along, ahead, turn = legs
    across: NDArray[np.complex128] = over_ground * along.conj()
    with np.errstate(invalid="ignore"):
        known = np.isfinite(across + ahead + turn) & (across.real * ahead >= 0)
    if known.sum() < FEWEST_LEGS:
        return []
    ways = [np.stack([way.real, way.imag]) for way in map(np.asarray, (along, ahead * along, ahead * along**2))]
    rows = np.concatenate([[np.ones(len(turn)), ahead, turn * ahead], *ways])[:, known].T
    fits = jackknife(rows, across.imag[known])[:, -4:]
    errors = (BLOCKS - 1) * fits[1:].var(0)
    return [(math.hypot(*fits[0, k : k + 2]), math.sqrt(errors[k : k + 2].sum())) for k in (0, 2)]
