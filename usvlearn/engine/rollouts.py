"""Runs of an estimator over samples, by torch, or by the engine (compiled code) where no gradient is asked for."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from usvlearn.core.plans import NONE, Forecast, check_plan
from usvlearn.core.protocol import EVERY, Estimator, Kinds, State, Step, advance, clean, spec_of
from usvlearn.core.samples import (
    Inputs,
    Sample,
    check_inputs,
    check_sample,
    named_leaves,
    one_number,
    rebuild,
    tree_map,
)
from usvlearn.engine.kinds import compilable
from usvlearn.errors import ConfigError, ShapeError, check_choice

BACKENDS = ("auto", "torch", "kernel")
CHUNK = 256  # most steps whose whole states are held at a time, for a `record` that is a function,
CELLS = 2**24  # and most numbers in those states
Record = Callable[[Any], Any] | Sequence[str]


def rollout(
    estimator: Estimator,
    state: State,
    samples: Sample,
    record: Record | None = None,
    backend: str = "auto",
) -> tuple[State, Tensor, Any]:
    """Run an estimator over samples, predicting before learning.

    Args:
        estimator: any `Estimator`.
        state: the state to start from, leaves `(*batch, ...)`.
        samples: leaves `(time, *batch)`, of the estimator's dtype, on the device of the state.
        record: names of leaves of the state (`named_leaves`), or a function that picks a tree of tensors from each new
            state.
        backend: "kernel" makes the steps by compiled code, which has no gradients; "torch" by torch; "auto" by
            compiled code where no gradient is asked for, all is on the CPU, and the estimator has a kernel.

    Returns:
        The last state; the predictions, m/s, `(time, *batch)`; what `record` names or picked, stacked over time (or
        None).

    Raises:
        ShapeError: the samples' dtype, batch or device does not fit the state.
        ConfigError: `backend="kernel"` where that cannot be.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> state, surge, _ = rollout(aid, aid.init(), samples)
    >>> abs(float(surge[-1].detach()) - 1.5) < 0.01
    True
    """
    _check(state, samples)
    pick = _picking(record, state)
    if (description := choose(estimator, state, samples, backend)) is not None:
        return run(description, state, samples, record, free=False)
    return _run(estimator, state, clean(samples, estimator.surge_limit), pick)


def simulate(
    estimator: Estimator, state: State, samples: Sample, record: Record | None = None, backend: str = "auto"
) -> tuple[State, Tensor, Any]:
    """Run an estimator free: it sees the inputs alone, learns nothing, and takes the speed only where a segment starts.

    The arguments are those of `rollout`; `samples.surge` counts only where `inputs.dt` is 0.

    Returns:
        As `rollout`. Where no step was made, `record` picks from the unchanged state.

    Raises:
        ShapeError, ConfigError: as `rollout`.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> float(simulate(aid, aid.init(), samples)[1][-1])  # it has learned nothing, whatever was measured
    0.0
    """
    _check(state, samples)
    pick = _picking(record, state)
    if (description := choose(estimator, state, samples, backend)) is not None:
        return run(description, state, samples, record, free=True)
    steps = clean(samples, estimator.surge_limit)
    return _run(estimator, state, steps._replace(learns=torch.zeros_like(steps.learns)), pick)


def forecast(estimator: Any, state: State, inputs: Inputs) -> Forecast:
    """Forecast lanes under plans, with intervals; the states are unchanged.

    Args:
        estimator: an `Ensemble` with forecasts.
        state: leaves `(*batch, …)`.
        inputs: of the plan's steps, tensors `(time, *batch)` in the state's dtype: commands −1 … 1, headings, rad, yaw
            rates, rad/s, and lengths of the steps, s.

    Returns:
        Tensors; `time` is `(time, *batch)` here, because lanes may have different steps.

    Raises:
        ConfigError: the estimator makes no forecasts, or a number is outside its legal range.
        ShapeError: the inputs do not fit each other.

    >>> from usvlearn import AID, Ensemble, ForecastSettings, Inputs
    >>> ensemble = Ensemble({"aid": AID(mass=28.0)}, forecasts=ForecastSettings())
    >>> t = torch.full((75, 8), 0.5, dtype=torch.float64)
    >>> forecast(ensemble, ensemble.init((8,)), Inputs(t, t, 0 * t, 0 * t, 0 * t + 0.4)).surge.shape
    torch.Size([75, 8])
    """
    if not hasattr(estimator, "forecast"):
        raise ConfigError(NONE)
    check_plan(Inputs(*map(_array, inputs)), tuple(state.predictions.shape[:-1]))
    surge, width = estimator.forecast(state, inputs)
    return Forecast(inputs.dt.cumsum(0), surge, surge - width, surge + width)


def stretches(
    estimator: Estimator, state: State, samples: Iterable[Sample], record: Sequence[str]
) -> Iterator[tuple[State, dict[str, np.ndarray]]]:
    """`rollout` without gradients, over consecutive stretches of NumPy samples, which the kernels read uncopied.

    Args:
        estimator, state: as of `rollout`.
        samples: arrays `(time, *batch)` each; numbers are converted to the dtype of the state.
        record: names of leaves of the state.

    Yields:
        The state after each stretch; the leaves after each of its steps, `(time, *batch, …)`.

    Raises:
        ShapeError: the first samples do not fit the state.
    """
    from usvlearn.engine.run import roll

    leaves, first = _arrays(state), True
    dtype = next(leaf.dtype for leaf in leaves.values() if leaf.dtype != bool)
    device = next(_leaves(state)).device
    for part in samples:
        part = tree_map(lambda x: x if x.dtype == bool else x.astype(dtype, copy=False), part)
        with torch.no_grad():
            if first:
                _check(state, whole := _moved(part, device))
                description, first = choose(estimator, state, whole, "auto"), False
            if description is not None:
                leaves, _, kept = roll(description, leaves, part, record=record, threads=torch.get_num_threads())
                state = _tree(state, leaves)
            else:
                state, _, named = rollout(estimator, state, _moved(part, device), record, backend="torch")
                kept = tree_map(_array, named)
        yield state, kept


def tensors(samples: Sample, dtype: torch.dtype, device: torch.device | str = "cpu") -> Sample:
    """NumPy samples as tensors on a device: numbers of this dtype, masks of bool."""
    return tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, _moved(samples, device))


def _moved(samples: Sample, device: torch.device | str) -> Sample:
    """NumPy samples as tensors on a device."""
    return tree_map(lambda x: torch.from_numpy(x).to(device), samples)


def _run(
    estimator: Estimator, state: State, steps: Step, pick: Callable[[State], Any] | None
) -> tuple[State, Tensor, Any]:
    """All steps by torch; leaves of `steps` are `(time, *batch)`."""
    holds = ~(steps.steps | steps.starts)
    kinds = steps.learns, steps.steps & ~steps.learns, steps.starts, holds
    occur = torch.stack([mask.reshape(len(mask), -1).any(1) for mask in kinds], 1)
    # Read once for all steps, because reading waits for an accelerator; where there are no values, all are assumed.
    known = not occur.is_meta and not _is_transformed(occur)
    some = [Kinds(*each) for each in occur.tolist()] if known else [EVERY] * len(occur)
    predictions, records = [], []
    for k, step in enumerate(_unbind(steps)):
        state, surge = advance(estimator, state, step, some[k])
        predictions.append(surge)
        if pick is not None:
            records.append(pick(state))
    return state, torch.stack(predictions), (stack(records) if records else None)


def _picking(record: Record | None, state: State) -> Callable[[State], Any] | None:
    """What `record` names or picks, as a function of the state."""
    if record is None or callable(record):
        return record
    leaves = dict(named_leaves(state))
    if unknown := [name for name in record if name not in leaves]:
        raise ConfigError(f"record: found {unknown[0]!r}, expected names of the state's leaves: {', '.join(leaves)}")
    names = tuple(record)
    return lambda state: {name: leaf for name, leaf in named_leaves(state) if name in names}


def _unbind(steps: Step) -> Iterator[Step]:
    """Yield the step of each time."""
    inputs = zip(*(x.unbind(0) for x in steps.inputs), strict=True)
    for x, *y in zip(inputs, *(y.unbind(0) for y in steps[1:]), strict=True):
        yield Step(Inputs(*x), *y)


def _check(state: State, samples: Sample) -> None:
    """Raise a ShapeError unless the samples fit each other and the state."""
    expected, dtype = samples.surge.shape, getattr(samples.surge, "dtype", None)
    device = getattr(samples.surge, "device", None)
    for name, leaf in named_leaves(samples):
        if not isinstance(leaf, Tensor):
            raise ShapeError(f"samples: {name} is {type(leaf).__name__}, expected a torch tensor: use torch.as_tensor")
        if leaf.shape != expected or len(expected) == 0 or len(leaf) == 0:
            raise ShapeError(
                f"samples: {name} has the shape {tuple(leaf.shape)}, surge {tuple(expected)}: expected (time, "
                "*batch), of at least one step, the same for all"
            )
        wanted = torch.bool if name in ("fresh", "measured") else dtype
        if leaf.dtype != wanted:
            raise ShapeError(f"samples: {name} is {leaf.dtype}, expected {wanted}: convert it with .to({wanted})")
        if leaf.device != device:
            raise ShapeError(f"samples: {name} is on {leaf.device}, surge on {device}: move all with .to({device})")
    batch = tuple(expected[1:])
    for name, leaf in named_leaves(state):
        if leaf.is_floating_point() and leaf.dtype != dtype:
            raise ShapeError(
                f"samples are {dtype}, the state's {name} is {leaf.dtype}: convert the estimator with .to({dtype}) "
                "before init, or the samples"
            )
        if leaf.device != device:
            raise ShapeError(
                f"samples are on {device}, the state's {name} is on {leaf.device}: move the estimator with "
                f'.to("{device}") before init, or the samples'
            )
        if tuple(leaf.shape[: len(batch)]) != batch:
            raise ShapeError(
                f"samples have the batch {batch}, the state's {name} has the shape {tuple(leaf.shape)}: "
                f"make the state with estimator.init({batch})"
            )


def choose(estimator: Estimator, state: Any, samples: Sample, backend: str) -> dict[str, Any] | None:
    """The specification that the kernels run (`Estimator.spec`), or None where torch makes the steps.

    Raises:
        ConfigError: the backend is unknown, or is "kernel" where the kernels cannot run.
    """
    if check_choice("backend", backend, BACKENDS) == "torch":
        return None
    own = [*estimator.parameters(), *estimator.buffers()]
    tensors = [*_leaves(state), *_leaves(samples), *own]
    obstacle = _out_of_reach(tensors) or _derivative(tensors)
    if not obstacle and samples.surge.numel() == 0:
        obstacle = "there are no lanes"
    return _description(estimator, obstacle, backend)


def run(
    description: dict[str, Any], state: Any, samples: Sample, record: Record | None, free: bool
) -> tuple[Any, Tensor, Any]:
    """`rollout`, or `simulate` (`free`), by the kernels."""
    from usvlearn.engine.run import roll

    leaves, arrays = _arrays(state), tree_map(_array, samples)
    threads = torch.get_num_threads()
    if not callable(record):
        leaves, predictions, kept = roll(description, leaves, arrays, free, record or (), threads)
        named = {name: torch.from_numpy(x) for name, x in kept.items()}
        return _tree(state, leaves), torch.from_numpy(predictions), None if record is None else named
    parts, records = [], []
    steps = max(1, min(CHUNK, CELLS // sum(x.size for x in leaves.values())))
    for begin in range(0, len(arrays.surge), steps):
        part = tree_map(lambda x, b=begin: x[b : b + steps], arrays)
        leaves, predictions, kept = roll(description, leaves, part, free, tuple(leaves), threads)
        parts.append(torch.from_numpy(predictions))
        for k in range(len(predictions)):
            records.append(record(_tree(state, {name: x[k] for name, x in kept.items()})))
    return _tree(state, leaves), torch.cat(parts), stack(records)


def stack(trees: Sequence[Any]) -> Any:
    """Trees of tensors as one, with a first axis that counts them.

    >>> stack([{"theta": torch.zeros(2)}, {"theta": torch.ones(2)}])["theta"].shape
    torch.Size([2, 2])
    """
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)


def free_totals(description: dict[str, Any], state: Any, samples: Sample, learning: Sequence[int]) -> np.ndarray:
    """`engine.free_runs.free_totals` of tensors."""
    from usvlearn.engine import free_runs

    return free_runs.free_totals(
        description, _arrays(state), tree_map(_array, samples), learning, torch.get_num_threads()
    )


def _array(x: Tensor) -> np.ndarray:
    """A tensor as an array that shares its memory where it can."""
    return x.detach().cpu().resolve_neg().numpy()  # numpy(force=True) takes ten times as long


def _arrays(state: Any) -> dict[str, np.ndarray]:
    """A state's leaves as arrays, by dotted name."""
    return {name: _array(leaf) for name, leaf in named_leaves(state)}


def _tree(template: Any, leaves: dict[str, np.ndarray], device: torch.device | None = None) -> Any:
    """A state like the template, from leaves by dotted name."""
    return rebuild(template, {name: torch.as_tensor(leaf, device=device) for name, leaf in leaves.items()})


def _description(estimator: Estimator, obstacle: str | None, backend: str) -> dict[str, Any] | None:
    """The specification that the kernels run; where they cannot, None, or a ConfigError if they were asked for."""
    if not obstacle and importlib.util.find_spec("numba") is None:
        obstacle = "numba is not installed (pip install numba)"
    description = None if obstacle else spec_of(estimator)
    if not obstacle and not compilable(description):
        obstacle = f"{type(estimator).__name__}, or a part of it, has no compiled kernel"
    if backend == "kernel" and obstacle:
        raise ConfigError(f"backend: found kernel, but {obstacle}: use auto or torch")
    return None if obstacle else description


def _out_of_reach(tensors: Sequence[Tensor]) -> str | None:
    """Why the kernels cannot read these numbers, if they cannot."""
    if any(map(_is_transformed, tensors)):
        return "torch transforms this function"
    if any(x.device.type != "cpu" for x in tensors):
        return "not all tensors are on the CPU"
    dtypes = {x.dtype for x in tensors if x.is_floating_point()}
    if dtypes not in ({torch.float64}, {torch.float32}):
        return f"the numbers are {' and '.join(sorted(map(str, dtypes)))}"
    return None


def _is_transformed(x: Tensor) -> bool:
    """Whether `torch.func` maps over a tensor or differentiates by it, or `torch.compile` traces."""
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor  # pyright: ignore  # torch has no stub of this module
    return torch.compiler.is_compiling() or bool(wrapped(x))


def _derivative(tensors: Sequence[Tensor]) -> str | None:
    """Which derivative is asked for, so that torch must make the steps, if one is."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
        return "a gradient is asked for (inside torch.no_grad() none is)"
    if any(x.is_floating_point() and unpack_dual(x).tangent is not None for x in tensors):
        return "a forward derivative is asked for"
    return None


class Stepper:
    """The steps of one state by torch, without gradients, on numbers of any type; as `engine.single_steps.Live`."""

    def __init__(self, estimator: Estimator, batch: Sequence[int]):
        self.estimator, self.batch = estimator, tuple(batch)
        self.state = tree_map(Tensor.detach, estimator.init(batch))
        self._like = next(leaf for leaf in _leaves(self.state) if leaf.is_floating_point())

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        return _arrays(self.state)

    @leaves.setter
    def leaves(self, leaves: dict[str, np.ndarray]) -> None:
        self.state = self.tree(leaves)

    def tree(self, leaves: dict[str, np.ndarray]) -> Any:
        """A state like its own, from leaves by dotted name."""
        return _tree(self.state, leaves, self._like.device)

    @torch.no_grad()
    def predict(self, inputs: Inputs) -> float | np.ndarray:
        check_inputs(inputs, self.batch)
        return _plain(self.estimator.predict(self.state, Inputs(*map(self._float, inputs)))[1])

    @torch.no_grad()
    def step(self, sample: Sample) -> float | np.ndarray:
        check_sample(sample, self.batch)
        inputs, surge, fresh, measured = sample
        sample = Sample(Inputs(*map(self._float, inputs)), self._float(surge), self._bool(fresh), self._bool(measured))
        self.state, predicted = self.estimator(self.state, sample)
        return _plain(predicted)

    def leaf(self, name: str) -> np.ndarray:
        return self.leaves[name]

    def last_predictions(self) -> tuple[np.ndarray, np.ndarray]:
        return self._pair(self.state)

    @torch.no_grad()
    def predict_members(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        check_inputs(inputs, self.batch)
        return self._pair(self.estimator.predict(self.state, Inputs(*map(self._float, inputs)))[0])

    @staticmethod
    def _pair(state: Any) -> tuple[np.ndarray, np.ndarray]:
        return _array(state.predictions), _array(state.halfwidths)

    @torch.no_grad()
    def forecast(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        estimator: Any = self.estimator
        if not hasattr(estimator, "forecast"):
            raise ConfigError(NONE)
        plan = Inputs(*(torch.tensor(x, dtype=self._like.dtype, device=self._like.device) for x in inputs))
        surge, width = estimator.forecast(self.state, plan)
        return _array(surge), _array(width)

    def _float(self, value: Any) -> Tensor:
        return torch.as_tensor(one_number(value), dtype=self._like.dtype, device=self._like.device).expand(self.batch)

    def _bool(self, value: Any) -> Tensor:
        return torch.as_tensor(one_number(value), dtype=torch.bool, device=self._like.device).expand(self.batch)


def live(estimator: Estimator, state: Any, backend: str) -> Any:
    """An `engine.single_steps.Live` of a state, or None where torch has to make the steps.

    Raises:
        ConfigError: as `choose`.
    """
    if check_choice("backend", backend, BACKENDS) == "torch":
        return None
    obstacle = _out_of_reach([*_leaves(state), *estimator.parameters(), *estimator.buffers()])
    if (description := _description(estimator, obstacle, backend)) is None:
        return None
    from usvlearn.engine.single_steps import Live

    return Live(description, _arrays(state))


def _plain(predicted: Tensor) -> float | np.ndarray:
    return _array(predicted) if predicted.ndim else predicted.item()


def _leaves(tree: Any) -> Iterator[Tensor]:
    return (leaf for _, leaf in named_leaves(tree))
