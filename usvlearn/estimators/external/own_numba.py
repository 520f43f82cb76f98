"""Numba functions of one's own as a member of an ensemble."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.protocol import Step
from usvlearn.errors import ConfigError, MemberError
from usvlearn.estimators.external.inputs import Stretched, X, columns_of


class OwnKernelState(NamedTuple):
    """What is known."""

    surge: Tensor  # (*batch,) from which the next step departs, m/s
    own: Tensor  # (*batch, size) the numbers of the class


class OwnKernel(Stretched):
    """An estimator whose steps are functions that numba compiles; `kernel` makes such a class."""

    first: tuple[float, ...]
    settings: dict[str, float]
    functions: tuple[Callable[..., Any], Callable[..., Any]]

    def __init__(self, **settings: float):
        super().__init__()
        if unknown := sorted(settings.keys() - self.settings.keys()):
            raise ConfigError(f"{unknown[0]}: found no such setting, expected {', '.join(self.settings) or 'none'}")
        numbers = {name: float(value) for name, value in (self.settings | settings).items()}
        self.numbers: Any = _settings(tuple(numbers))(**numbers) if numbers else ()

    def init(self, batch: Sequence[int] = ()) -> OwnKernelState:
        first = self.rest.new_tensor(self.first)
        return OwnKernelState(self.rest.expand(tuple(batch)).clone(), first.expand(*batch, len(first)).clone())

    def stretch(self, state: OwnKernelState, steps: Step) -> tuple[OwnKernelState, Tensor]:
        wide, modes = (x.numpy() for x in columns_of(steps))
        surge, memory = state.surge.reshape(-1).clone().numpy(), state.own.reshape(-1, len(self.first)).clone().numpy()
        predicted, at = np.full(modes.shape, np.nan, wide.dtype), np.zeros(1, np.int64)
        try:
            loop(*self.functions)(wide, modes, surge, memory, self.numbers, predicted, at)
        except Exception as error:
            predicted[at[0] :] = np.nan
            raise MemberError(int(at[0]), torch.from_numpy(predicted).reshape(steps.surge.shape)) from error
        new = OwnKernelState(
            torch.from_numpy(surge).reshape(state.surge.shape), torch.from_numpy(memory).reshape(state.own.shape)
        )
        return new, torch.from_numpy(predicted).reshape(steps.surge.shape)


def kernel(definition: type) -> type[OwnKernel]:
    """Make an estimator of a class with two numba functions, which are compiled at the first step.

    Its functions are `predict(s, x, p)`, which returns the speed at the end of the step, m/s, and `learn(s, x, y, p)`,
    which is given the measured one, and changes `s`. `s` is an array of what the class remembers, `x` an `X`
    (`estimators.external.inputs`: x.speed, x.left …), `p` has the settings by name: p.rate.

    Args:
        definition: a class with these; `state`, how many numbers it remembers, 0 at first, or their first values;
            and settings, other attributes that are numbers, which the estimator takes as arguments.

    Returns:
        The estimator's class.

    Raises:
        ConfigError: a function or `state` is missing.

    >>> from usvlearn import Ensemble, kernel
    >>> @kernel
    ... class Smoothing:
    ...     state, rate = 1, 0.5
    ...
    ...     def predict(s, x, p):
    ...         return s[0]
    ...
    ...     def learn(s, x, y, p):
    ...         s[0] += p.rate * (y - s[0])
    >>> Ensemble({"mine": Smoothing(rate=0.3)}).external
    ('mine',)
    """
    space = vars(definition)
    if missing := [name for name in ("predict", "learn", "state") if name not in space]:
        raise ConfigError(
            f"{definition.__name__}: found no {missing[0]}, expected predict(s, x, p), learn(s, x, y, p), state"
        )
    first = (0.0,) * space["state"] if isinstance(space["state"], int) else tuple(map(float, space["state"]))
    settings = {name: value for name, value in space.items() if type(value) in (int, float) and name != "state"}
    named = {key: space.get(key) for key in ("__module__", "__doc__", "__qualname__") if key in space}
    facts = {"first": first, "settings": settings, "functions": (space["predict"], space["learn"])}
    return type(definition.__name__, (OwnKernel,), named | facts)


@cache
def _settings(names: tuple[str, ...]) -> Any:
    """Their type: one for the same names, because numba compiles anew for another one."""
    return namedtuple("Settings", names)


@cache
def loop(predict: Callable[..., Any], learn: Callable[..., Any]) -> Callable[..., None]:
    """All steps of all vehicles, compiled."""
    from numba import njit

    ask, teach = njit(predict), njit(learn)

    @njit
    def steps(wide: Any, modes: Any, surge: Any, memory: Any, p: Any, predicted: Any, at: Any) -> None:
        for k in range(len(modes)):
            at[0] = k
            for e in range(modes.shape[1]):
                row, mode = wide[k, e], modes[k, e]
                if mode == 1:
                    surge[e] = row[9]
                elif mode > 1:
                    x = X(surge[e], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8])
                    predicted[k, e] = surge_after = ask(memory[e], x, p)
                    if mode == 3:
                        teach(memory[e], x, row[9], p)
                        surge_after = row[9]
                    surge[e] = surge_after

    return steps
