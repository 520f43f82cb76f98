"""Gusts of wind: each pushes the boat and turns it for some seconds.

    w(t) = strength sin²(π (t − t₀)/T) where 0 < t − t₀ < T,                      T the length of the gust        (1)
    force ahead = push Σ w cos(δ − ψ),   settled yaw rate = … + turn Σ w sin(δ − ψ)                               (2)

δ is where a gust blows to, ψ the heading; `push` is a share of the thrust of both sides at full command.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from usvlearn.errors import ConfigError, check_not_negative
from usvlearn.simulate.vessel import Vessel, static_thrust


@dataclass(frozen=True)
class Gusts:
    """How often the wind blows, how long and how hard.

    Args:
        per_hour: mean number of gusts, 1/h; they come at random times, from anywhere, with strengths of 0 to 1.
        push: force of the strongest one, share of the thrust of both sides at full command.
        turn: settled yaw rate of the strongest one, rad/s.
        seconds: shortest and longest gust, s.
        minute: min of every mission at which one gust of strength 1 begins; null: none.

    Raises:
        ConfigError: a number outside its range.

    >>> Gusts().push
    0.15
    """

    per_hour: float = 20.0
    push: float = 0.15
    turn: float = 0.1
    seconds: tuple[float, float] = (5.0, 40.0)
    minute: float | None = None

    def __post_init__(self):
        for name in ("per_hour", "push", "turn"):
            check_not_negative(name, getattr(self, name))
        if self.minute is not None:
            check_not_negative("minute", self.minute)
        if len(self.seconds) != 2 or not 0 < self.seconds[0] <= self.seconds[1]:
            raise ConfigError(f"seconds: found {self.seconds!r}, expected the shortest and longest gust in s")

    def course(self, rng: np.random.Generator, ticks: int, hz: float) -> np.ndarray:
        """Σ w cos δ and Σ w sin δ of one mission.

        Args:
            rng: of the gusts.
            ticks: number of ticks.
            hz: ticks a second, 1/s.

        Returns:
            No unit, `(ticks, 2)`.

        >>> course = Gusts(per_hour=0.0, minute=0.0, seconds=(10.0, 10.0)).course(np.random.default_rng(0), 60, 4.0)
        >>> np.hypot(*course.T)[[0, 20, 40]].round(6).tolist()
        [0.0, 1.0, 0.0]
        """
        time, wind = np.arange(ticks) / hz, np.zeros((ticks, 2))
        begins = rng.uniform(0, ticks / hz, rng.poisson(self.per_hour * ticks / hz / 3600))
        strengths = rng.random(len(begins))
        if self.minute is not None:
            begins, strengths = np.append(begins, 60 * self.minute), np.append(strengths, 1.0)
        for begin, strength in zip(begins, strengths, strict=True):
            direction, length = rng.uniform(0, 2 * math.pi), rng.uniform(*self.seconds)
            during = slice(math.floor(begin * hz), math.ceil((begin + length) * hz) + 1)
            share = ((time[during] - begin) / length).clip(0, 1)
            w = strength * np.sin(math.pi * share) ** 2  # (1)
            wind[during] += w[:, None] * np.array([math.cos(direction), math.sin(direction)])
        return wind

    def strength(self, vessel: Vessel) -> tuple[Tensor, Tensor]:
        """The force and the settled yaw rate of the strongest gust.

        Args:
            vessel: whose thrust the force is a share of.

        Returns:
            Force, N, and yaw rate, rad/s, `(*batch,)` each.

        >>> from usvlearn.simulate.plants import heron
        >>> round(Gusts(push=0.5).strength(heron())[0].item(), 1)
        33.6
        """
        full = static_thrust(vessel, torch.ones(2, dtype=torch.float64)).sum(-1)
        return self.push * full, torch.full_like(full, self.turn)
