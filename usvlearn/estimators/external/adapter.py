"""Models of other libraries as members of an ensemble."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.protocol import Step
from usvlearn.errors import ConfigError, MemberError, check_choice
from usvlearn.estimators.external.inputs import Stretched, X, columns_of
from usvlearn.estimators.external.plain_state import packed, unpacked

NAMES = X._fields


class ExternalState(NamedTuple):
    """What is known of a model."""

    surge: Tensor  # (*batch,) from which the next step departs, m/s
    model: Tensor  # (*batch, state_size) bytes, its state


class External(Stretched):
    """What `external` makes; each vehicle has a copy of the model."""

    def __init__(self, model: Any, target: str, state_size: int):
        super().__init__()
        self.model, self.target = model, check_choice("target", target, ("speed", "change"))
        self.size, self._run = int(state_size), 0
        self._ask, self._teach = _calls(model)
        self._kept: tuple[Tensor, list[Any]] | None = None
        self.cause = ""  # why it cannot be resumed
        self._packed([model])

    def init(self, batch: Sequence[int] = ()) -> ExternalState:
        packed = torch.from_numpy(self._packed([self.model])[0])
        return ExternalState(self.rest.expand(tuple(batch)).clone(), packed.expand(*batch, self.size).clone())

    def stretch(self, state: ExternalState, steps: Step) -> tuple[ExternalState, Tensor]:
        models, speeds = self._models(state.model), state.surge.reshape(-1).tolist()
        wide, modes = columns_of(steps)
        predicted, change = np.full(modes.shape, np.nan), self.target == "change"
        for k, (row, mode) in enumerate(zip(wide.tolist(), modes.tolist(), strict=True)):
            try:
                for e, (_, *others, surge) in enumerate(row):
                    if mode[e] == 1:
                        speeds[e] = surge
                    elif mode[e] > 1:
                        before = speeds[e] if change else 0.0
                        x = X(speeds[e], *others)
                        asked = self._ask(models[e], x)
                        speed = speeds[e] if asked is None else np.asarray(asked, float).item() + before
                        predicted[k, e] = speed
                        if mode[e] == 3:
                            self._teach(models[e], x, surge - before)
                            speed = surge
                        speeds[e] = speed
            except Exception as error:
                self._kept = None
                raise MemberError(k, torch.from_numpy(predicted).reshape(steps.surge.shape).to(steps.surge)) from error
        content = state.model
        if bool((modes == 3).any()):
            content = torch.from_numpy(self._packed(models)).reshape(state.model.shape)
            self._kept = content, models
        surge = torch.tensor(speeds, dtype=state.surge.dtype).reshape(state.surge.shape)
        return ExternalState(surge, content), torch.from_numpy(predicted).reshape(steps.surge.shape).to(steps.surge)

    def _models(self, content: Tensor) -> list[Any]:
        """The models of all vehicles, in these states."""
        if self._kept is not None and torch.equal(self._kept[0], content):
            return self._kept[1]
        rows = content.reshape(-1, self.size).numpy()
        if not self.cause:
            return [unpacked(row, copy.deepcopy(self.model)) for row in rows]
        if any(row.any() for row in rows):
            raise ConfigError(f"found a state of another session or of an earlier step: {self.cause}")
        return [copy.deepcopy(self.model) for _ in rows]

    def _packed(self, models: Sequence[Any]) -> np.ndarray:
        """Their states; of a model without any, how often one was asked for."""
        if not self.cause:
            try:
                return np.stack([packed(model, self.size) for model in models])
            except TypeError as error:
                self.cause = f"{type(self.model).__name__} cannot be resumed ({error}): give it get_state and set_state"
                warnings.warn(self.cause, stacklevel=3)
        content = np.zeros((len(models), self.size), np.uint8)
        if models[0] is not self.model:
            self._run += 1
            content[:, :8] = np.frombuffer(self._run.to_bytes(8, "little"), np.uint8)
        return content


def external(model: Any, target: str = "speed", state_size: int = 16384) -> External:
    """Make an estimator of a model of another library, or of any object; each vehicle has a copy of it.

    River's models have `learn_one` and `predict_one`, and get a dictionary; scikit-learn's have `partial_fit` and
    `predict`, and get an array, `(1, 9)`; any other object has `predict(x)` and `learn(x, y)`, and gets an `X`. In all
    of them are, by name: speed, left, right, mean, mean_square, sin, cos, yaw_rate, dt (`estimators.external.inputs`).

    A checkpoint has the state of the model: what its method `get_state` returns, which are numbers, text, arrays and
    containers of them, and its method `set_state` takes; without them its attributes, if they are such. Nothing is
    pickled. Where that is not possible, a warning says that this member cannot be resumed.

    Args:
        model: as it is before the first sample.
        target: what it learns: the "speed" at the end of the step, m/s, or its "change" in the step.
        state_size: of its state, at most, compressed, bytes.

    Returns:
        The estimator.

    Raises:
        ConfigError: it has no such methods.

    >>> class Still:
    ...     def predict(self, x):
    ...         return x.speed
    ...
    ...     def learn(self, x, y):
    ...         pass
    >>> from usvlearn import BOA, Ensemble, JointEKF, external
    >>> ensemble = Ensemble({"joint": JointEKF(2.7), "still": external(Still())}, {"ensemble": BOA()})
    >>> ensemble.external
    ('still',)
    """
    return External(model, target, state_size)


def _calls(model: Any) -> tuple[Callable[[Any, X], Any], Callable[[Any, X, float], Any]]:
    """How a model is asked, None where it cannot say yet, and how it learns."""
    if hasattr(model, "predict_one") and hasattr(model, "learn_one"):
        return lambda m, x: m.predict_one(x._asdict()), lambda m, x, y: m.learn_one(x._asdict(), y)
    if hasattr(model, "predict") and hasattr(model, "partial_fit"):
        return (
            lambda m, x: m.predict(np.array([x]))[0] if _fitted(m) else None,
            lambda m, x, y: m.partial_fit(np.array([x]), [y]),
        )
    if hasattr(model, "predict") and hasattr(model, "learn"):
        return lambda m, x: m.predict(x), lambda m, x, y: m.learn(x, y)
    raise ConfigError(
        f"model: found {type(model).__name__}, expected an object with predict_one and learn_one, predict and "
        "partial_fit, or predict and learn"
    )


def _fitted(model: Any) -> bool:
    """Whether a model of scikit-learn has learned: it then has attributes whose names end with an underscore."""
    return any(name.endswith("_") and not name.startswith("_") for name in vars(model))
