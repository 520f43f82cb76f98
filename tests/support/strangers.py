"""A planar boat that goes astern at times, as columns of a stranger's log, and what `inspect` concludes of them."""

from functools import cache

import numpy as np

from usvlearn.logs.channels.series import Series
from usvlearn.logs.inspection.candidate import candidates
from usvlearn.logs.inspection.proposal import Proposal, propose

STEP = 0.25  # s


@cache
def sail(minutes: float = 4.0, seed: int = 1, lowest: float = -0.8, dies: str = "") -> dict[str, np.ndarray]:
    """Shares of thrust `l` and `r`, heading `psi`, rate `turn`, surge `u`, and place `n`, `e`, every `STEP`.

    A thruster dies half-way.
    """
    rng, rows, left_over, l, r = np.random.default_rng(seed), [], 0.0, 0.0, 0.0  # noqa: E741
    u = v = turn = psi = n = e = 0.0
    for k in range(int(minutes * 60 / 0.05)):
        if (left_over := left_over - 0.05) <= 0:
            left_over, base = rng.uniform(4, 12), rng.choice([rng.uniform(0.2, 1), 0.0, lowest], p=[0.7, 0.15, 0.15])
            way = rng.uniform(-0.4, 0.4) * (rng.random() < 0.6) * (base != 0)
            l, r = (float(np.clip(base + each, min(lowest, 0), 1)) for each in (way, -way))  # noqa: E741
        left = dies and k > minutes * 600
        push = [45 * (0.3 * c + 0.7 * c * abs(c)) * (not left or side != dies) for side, c in (("l", l), ("r", r))]
        u += 0.05 * ((sum(push) - 6 * u - 14 * u * abs(u)) / 32 + v * turn)
        v += 0.05 * ((-30 * v - 60 * v * abs(v)) / 51 - 0.6 * u * turn)
        turn += 0.05 * (0.55 * (push[0] - push[1]) - 8 * turn - 14 * turn * abs(turn)) / 9
        psi += 0.05 * turn
        n += 0.05 * (u * np.cos(psi) - v * np.sin(psi))
        e += 0.05 * (u * np.sin(psi) + v * np.cos(psi))
        if k % 5 == 0:
            rows.append((0.05 * k, l, r, psi, turn, u, v, n, e))
    names = ("time", "l", "r", "psi", "turn", "u", "v", "n", "e")
    boat = dict(zip(names, np.array(rows).T, strict=True))
    boat["u"] = boat["u"] + rng.normal(0, 0.02, len(rows))
    boat["hdg"], boat["sog"] = np.degrees(boat["psi"]) % 360, np.hypot(boat["u"], boat["v"])
    boat["cog"] = np.degrees(boat["psi"] + np.arctan2(boat["v"], boat["u"])) % 360
    boat["lat"] = 42.3 + boat["n"] / 111195
    boat["lon"] = -71.1 + boat["e"] / 111195 / np.cos(np.radians(42.3))
    return boat


def concluded(boat: dict[str, np.ndarray], convention: str = "CSV", **columns: np.ndarray) -> Proposal:
    """What is concluded of a table with these columns; `name__field` is a field of a message."""
    series = []
    for name, value in columns.items():
        place, _, field = name.partition("__")
        order = np.arange(len(value))
        series.append(Series(place, field or None, boat["time"], np.asarray(value, float), order))
    return propose(candidates(series), convention)


def told(proposal: Proposal) -> dict[tuple[str, str], tuple[str, str]]:
    """Channel and what -> value and certainty."""
    return {each[:2]: (each.value, each.certainty) for each in proposal.decisions}


def pulses(share):
    return np.round(1500 + 400 * share)


def driven(boat, **columns):
    return concluded(boat, pwm_left=pulses(boat["l"]), pwm_right=pulses(boat["r"]), heading=boat["hdg"], **columns)


def tell(boat, name, **columns):
    return told(driven(boat, **columns))[tuple(name.split())]
