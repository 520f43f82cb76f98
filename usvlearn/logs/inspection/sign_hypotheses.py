"""Which of two commands drives which side of a boat, and which of them is reversed: one decision.

There are eight hypotheses: the sides are as named or swapped, and each command is positive ahead or reversed. Under
each of them a boat must move as boats do. With the command c of a side behind a lag of the boat's time constant,

    speed    v = a₁ c₁ + a₂ c₂,    aₖ > 0 where the command is positive ahead, aₖ < 0 where it is reversed     (1)
    turn     r = b₁ c₁ + b₂ c₂,    bₖ > 0 on the left, bₖ < 0 on the right; the opposite where it is reversed  (2)

and the gains of both sides differ by a factor of at most `UNEQUAL`. The cost of a hypothesis is that of the gains
nearest to the fitted ones that it allows, with the fit's information matrix P = C⁻¹ and ν degrees of freedom:

    Q = min over the allowed g of (g − ĝ)ᵀ P (g − ĝ),    cost = (ν + 2) log(1 + Q/ν)                        (3)

This is −2 log likelihood of a Student t. C is the covariance of the fit over blocks of the log: neighbouring values
depend on each other, so that an hour may be few samples. Names and habit are costs, too: `SWAPPED` and `REVERSED`.
Where the sense of the heading is not proved, a turn against the names is as well that of a mirrored heading: the names
are kept then.

There is no constant in (1) and (2), so that a boat that goes ahead at a constant speed tells the sign of its commands.
The change of the speed alone does not: a speed controller opens the throttle where the boat is slow. Where the zero of
a command is not known, a hypothesis costs the less of fits without and with a constant: both must speak against it.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import bin_edges, bin_means, clipped
from usvlearn.logs.inspection.position_channels import Pair

STEP = 0.5  # s, of the bins
SPEED_TIMES, TURN_TIMES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), (0.5, 1.0, 2.0, 4.0)  # s, time constants that are tried
BLOCK, FEWEST, MOST = 30.0, 4, 40  # s, of a block; blocks
LONGEST = 12.0  # time constants after which a command is forgotten
LEAST = 0.02  # range of the commands, share of full scale, below which they tell nothing
OWN_ERROR = 0.3  # standard deviation of the gains, relative, beside the fit's: turns slow a boat, thrust is not linear
UNEQUAL = 4.0  # ratio of the gains of both sides, at most
SWAPPED, MIRRORED, REVERSED = 10.0, 4.0, 6.0  # costs; of a heading that may count the other way
ALONE = 0.3  # share of the greater gain, below which a command of a throttle or of a rudder drives nothing
SURE, LIKELY = 14.0, 6.0  # costs by which the motion speaks against every other decision: certain, probable
MOST_SUPPORT = 10.0  # of one relation, in ranking pairs of series


class Senses(NamedTuple):
    """What two commands do, as a boat that has them can move."""

    swapped: bool  # whether the first command drives the right side
    first: int  # 1, or -1 if this command is reversed
    second: int


HYPOTHESES = tuple(Senses(swapped, *signs) for swapped in (False, True) for signs in product((1, -1), repeat=2))


class Fit(NamedTuple):
    """The gains of (1) or (2)."""

    gains: np.ndarray  # (2,) m/s or rad/s at full command of one side
    information: np.ndarray  # (2, 2), P
    freedom: float  # ν

    def cost(self, signs: tuple[int, int]) -> float:
        """Equation (3)."""
        return self.cost_of(self.nearest(signs))

    def cost_of(self, gains: np.ndarray) -> float:
        """Equation (3) for given gains, `(2,)`."""
        off = gains - self.gains
        return (self.freedom + 2) * math.log1p(float(off @ self.information @ off) / self.freedom)

    def nearest(self, signs: tuple[int, int]) -> np.ndarray:
        """The nearest gains of these signs whose ratio is at most `UNEQUAL`, `(2,)`."""
        edges = np.array(signs) * np.array([[1.0, 1 / UNEQUAL], [1 / UNEQUAL, 1.0]])
        P, inside = self.information, np.linalg.solve(edges.T, self.gains)
        if (inside >= 0).all():
            return self.gains
        along = [max(0.0, float(edge @ P @ self.gains / (edge @ P @ edge))) * edge for edge in edges]
        return min(along, key=lambda g: float((g - self.gains) @ P @ (g - self.gains)))


def fit_gains(
    first: Pair, second: Pair, response: Pair | None, times: tuple[float, ...], level: bool = True
) -> Fit | None:
    """The gains of two commands, shares, with the best of some time constants, s; None with too little evidence.

    The response is the speed, m/s, or the yaw rate, rad/s; `level` says whether there is no constant.
    """
    if response is None:
        return None
    edges = bin_edges(STEP, response)
    commands = np.stack([bin_means(each, edges, held=True) for each in (first, second)])
    if not commands.size:
        return None
    values = clipped(bin_means(response, edges))
    known = np.isfinite(values) & np.isfinite(commands).all(0)
    at = (edges[:-1] + edges[1:])[known] / 2
    blocks = (
        np.unique(np.floor((at - at[0]) / max(BLOCK, np.ptp(at) / MOST)), return_inverse=True)[1] if at.size else at
    )
    if not at.size or (count := int(blocks.max()) + 1) < FEWEST or np.ptp(commands[:, known]) < LEAST:
        return None
    filled = np.where(np.isfinite(commands), commands, 0.0)
    fits = [_regression(_filtered(filled, time)[:, known], values[known], level) for time in times]
    rows, gains, left = min(fits, key=lambda fit: float(fit[2] @ fit[2]))
    scores = np.stack([np.bincount(blocks, row * left, count) for row in rows])
    inverse = np.linalg.pinv(rows @ rows.T, hermitian=True)
    freedom = max(count - len(rows), 1)
    covariance = inverse @ (scores @ scores.T) @ inverse * count / freedom
    across = OWN_ERROR * np.array([-gains[1], gains[0]])
    spread = covariance[:2, :2] + np.outer(across, across) + 1e-12 * np.eye(2)
    return Fit(gains[:2], np.linalg.inv(spread), float(freedom))


def _filtered(commands: np.ndarray, time: float) -> np.ndarray:
    """Commands behind a first-order lag that began at rest, and the decay of what was before, `(3, bins)`."""
    left = math.exp(-STEP / time)
    decay = left ** np.arange(1, commands.shape[1] + 1)
    kernel = (1 / left - 1) * decay[: math.ceil(LONGEST * time / STEP)]
    return np.stack([*(np.convolve(each, kernel)[: len(decay)] for each in commands), decay])


def _regression(rows: np.ndarray, values: np.ndarray, level: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows, their coefficients and the residuals."""
    rows = rows if level else np.vstack([rows, np.ones(rows.shape[1])])
    coefficients = np.linalg.lstsq(rows.T, values, rcond=1e-9)[0]
    return rows, coefficients, values - coefficients @ rows


class Decided(NamedTuple):
    """The decision about two commands."""

    taken: Senses
    best: Senses  # likewise; with other sides where only a proved heading could overrule the names
    rival: Senses  # the best one with other signs
    sides: float  # cost by which the motion speaks against the other sides than those of `taken`
    signs: float  # likewise, against other signs
    turning: float  # likewise, by the turn alone, against swapped sides with the same signs
    fits: tuple[tuple[Fit, ...], ...]  # of speed and turn; empty where there is too little evidence

    @property
    def throttle(self) -> int | None:
        """Which command is a throttle beside a rudder: it alone drives the speed, and the other one alone the turn."""
        if not all(self.fits):
            return None
        ahead, turn = (np.abs(fits[0].gains) for fits in self.fits)
        return next((k for k in (0, 1) if ahead[1 - k] < ALONE * ahead[k] and turn[k] < ALONE * turn[1 - k]), None)

    @property
    def support(self) -> float:
        """How well the motion follows the commands as they were taken, 0 to twice `MOST_SUPPORT`."""
        fits = ((_nearest(fit, signs), signs) for fit, signs in zip(self.fits, _signs(self.best), strict=True) if fit)
        return sum(min(MOST_SUPPORT, (fit.cost_of(np.zeros(2)) - fit.cost(signs)) / 2) for fit, signs in fits)

    def facts(self) -> str:
        """What a full command of each side does, as it is logged: the gains nearest to the fit that `best` allows."""
        effects: dict[str, list[str]] = {"left": [], "right": []}
        order = ("right", "left") if self.taken.swapped else ("left", "right")
        for fits, signs, factor, unit in zip(
            self.fits, _signs(self.best), (1.0, math.degrees(1.0)), ("m/s", "°/s"), strict=True
        ):
            if fits:
                for side, gain in zip(order, _nearest(fits, signs).nearest(signs), strict=True):
                    effects[side].append(f"{float(f'{factor * gain:.2g}') + 0.0:+g} {unit}")
        if not effects["left"]:
            return "neither speed nor turn tells"
        return "full command, as logged: " + "; ".join(f"{side} {', '.join(each)}" for side, each in effects.items())


def decide(
    first: Pair, second: Pair, speed: Pair | None, turn: Pair | None, level: bool, proved: bool, named: bool = True
) -> Decided:
    """Decide about sides and signs together.

    Given are the commands that are named left and right, shares of full scale; the speed, m/s; the yaw rate, rad/s,
    clockwise; whether the zeros of the commands are known; whether the sense of the heading is proved (else a turn
    against the names does not swap the sides); and whether the names tell the sides.
    """
    fits = tuple(
        tuple(fit for way in {True, level} if (fit := fit_gains(first, second, response, times, way)))
        for response, times in ((speed, SPEED_TIMES), (turn, TURN_TIMES))
    )
    motion = {each: sum(_cost(*pair) for pair in zip(fits, _signs(each), strict=True)) for each in HYPOTHESES}
    against = 0.0 if not named else SWAPPED if proved else MIRRORED
    whole = {each: x + against * each.swapped + REVERSED * (min(each[1:]) < 0) for each, x in motion.items()}
    best = min(whole, key=whole.__getitem__)
    taken = best if proved or not named else best._replace(swapped=False)
    rival = min((each for each in whole if each[1:] != best[1:]), key=motion.__getitem__)
    ahead, across = _signs(taken)[1], _signs(taken._replace(swapped=not taken.swapped))[1]
    sides = min(motion[each] for each in HYPOTHESES if each.swapped != taken.swapped) - motion[taken]
    turning = _cost(fits[1], across) - _cost(fits[1], ahead)
    return Decided(taken, best, rival, sides, motion[rival] - motion[best], turning, fits)


def pushes(command: Pair, speed: Pair | None, level: bool) -> tuple[int, float, str]:
    """Which way one command of both sides, a share, drives the boat by its speed, m/s: 1, or -1 if it is reversed.

    Then come the cost by which the motion speaks against the other sign, and this in words; `level` says whether the
    zero of the command is known.
    """
    fits = tuple(fit for way in {True, level} if (fit := fit_gains(command, command, speed, SPEED_TIMES, way)))
    if not fits:
        return 1, 0.0, "too little evidence in the speed"
    against = _cost(fits, (-1, -1)) - _cost(fits, (1, 1))
    sign = -1 if against < -REVERSED else 1
    full = float(f"{_nearest(fits, (sign, sign)).nearest((sign, sign)).sum():.2g}") + 0.0
    weak = "; weak evidence" if sign * against < LIKELY else ""
    return sign, sign * against, f"full throttle, as logged: {full:+g} m/s{weak}"


def _nearest(fits: tuple[Fit, ...], signs: tuple[int, int]) -> Fit:
    return min(fits, key=lambda fit: fit.cost(signs))


def _cost(fits: tuple[Fit, ...], signs: tuple[int, int]) -> float:
    return _nearest(fits, signs).cost(signs) if fits else 0.0


def _signs(each: Senses) -> tuple[tuple[int, int], tuple[int, int]]:
    """The signs of the gains of (1) and of (2)."""
    way = -1 if each.swapped else 1
    return (each.first, each.second), (way * each.first, -way * each.second)
