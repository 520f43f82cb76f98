"""Runs of an estimator over samples, by torch, or by the engine (compiled code) where no gradient is asked for."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.forecasts import NONE, Forecast, Track, check_plan
from usvlearn.core.protocol import Estimator, State, Step, clean
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.engine.backend import array_of, arrays_of, choose, out_of_reach, tensors_in, tree_of
from usvlearn.engine.torch_steps import walk
from usvlearn.engine.validate import afresh
from usvlearn.errors import ConfigError, ShapeError

if TYPE_CHECKING:
    from usvlearn.estimators.planar.layer import PlanarState

CHUNK = 256  # most steps whose whole states are held at a time, for a `record` that is a function,
CELLS = 2**24  # and most numbers in those states
Record = Callable[[Any], Any] | Sequence[str]


def rollout(
    estimator: Estimator, state: State, samples: Sample, record: Record | None = None, backend: str = "auto"
) -> tuple[State, Tensor, Any]:
    """Run an estimator over samples, predicting before learning.

    Args:
        estimator: any `Estimator`.
        state: the state to start from, leaves `(*batch, ...)`.
        samples: leaves `(time, *batch)`, of the estimator's dtype, on the device of the state.
        record: names of leaves of the state (`named_leaves`), or a function that picks a tree of tensors from each new
            state.
        backend: "kernel" makes the steps by compiled code, without gradients, also on a GPU; "torch" by torch; "auto"
            by compiled code where no gradient is asked for, all is on the CPU, and the estimator has a kernel.

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
        return run(description, state, samples, record, free=False, estimator=estimator)
    return _run(estimator, state, clean(samples, estimator.surge_limit), pick)


def simulate(
    estimator: Estimator, state: State, samples: Sample, record: Record | None = None, backend: str = "auto"
) -> tuple[State, Tensor, Any]:
    """Run an estimator free: it sees the inputs alone, learns nothing, and takes the speed only where a segment starts.

    `samples.surge` counts only where `inputs.dt` is 0.

    Args:
        estimator: any.
        state: from which it departs, leaves `(*batch, ...)`.
        samples: leaves `(time, *batch)`.
        record: as of `rollout`.
        backend: as of `rollout`.

    Returns:
        The last state; the simulated speeds, m/s, `(time, *batch)`, NaN where no step was made; and what `record`
        picked, of an unchanged state where no step was made.

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
        return run(description, state, samples, record, free=True, estimator=estimator)
    steps = clean(samples, estimator.surge_limit)
    return _run(estimator, state, steps._replace(learns=torch.zeros_like(steps.learns)), pick)


def forecast(estimator: Any, state: State, inputs: Inputs) -> Forecast | Track:
    """Forecast batch elements under plans, with intervals; the states are unchanged.

    Args:
        estimator: an `Ensemble` with forecasts; or a `Planar`, whose `inputs` have None for headings and yaw rates.
        state: leaves `(*batch, …)`.
        inputs: of the plan's steps, tensors `(time, *batch)` in the state's dtype: commands −1 … 1, headings, rad, yaw
            rates, rad/s, and lengths of the steps, s.

    Returns:
        Tensors; `time` is `(time, *batch)` here, because batch elements may have different steps. Of a `Planar` a
        `Track` of arrays, `(time, *batch)`, whose steps are of one length.

    Raises:
        ConfigError: the estimator makes no forecasts, or a number is outside its legal range.
        ShapeError: the inputs do not fit each other.

    >>> from usvlearn import AID, Ensemble, ForecastSettings, Inputs
    >>> ensemble = Ensemble({"aid": AID(mass=28.0)}, forecasts=ForecastSettings())
    >>> t = torch.full((75, 8), 0.5, dtype=torch.float64)
    >>> forecast(ensemble, ensemble.init((8,)), Inputs(t, t, 0 * t, 0 * t, 0 * t + 0.4)).surge.shape
    torch.Size([75, 8])
    """
    if inputs.heading is None:
        return _tracks(estimator, state, inputs)
    if not hasattr(estimator, "forecast"):
        raise ConfigError(NONE)
    check_plan(Inputs(*map(array_of, inputs)), tuple(state.predictions.shape[:-1]))
    surge, width = estimator.forecast(state, inputs)
    return Forecast(inputs.dt.cumsum(0), surge, surge - width, surge + width)


def _tracks(planar: Any, state: PlanarState, inputs: Inputs) -> Track:
    """`forecast` of boats in the plane."""
    from usvlearn.engine.single_steps import PlanarStepper

    if not hasattr(planar, "yaw"):
        raise ConfigError(
            f"inputs.heading: found None with {type(planar).__name__}, expected headings, or a Planar, which forecasts "
            "them, too"
        )
    left, right, dt = (np.asarray(x, float) for x in (inputs.command_left, inputs.command_right, inputs.dt))
    if dt.size == 0 or not (dt == dt.flat[0]).all():
        raise ConfigError(f"inputs.dt: found {dt.size} lengths that differ, expected one for all steps, s")
    return PlanarStepper(planar.description(), arrays_of(state)).track(np.stack([left, right], -1), float(dt.flat[0]))


def chunked_rollout(
    estimator: Any, state: Any, samples: Iterable[Any], record: Sequence[str]
) -> Iterator[tuple[Any, dict[str, np.ndarray]]]:
    """`rollout` without gradients, over consecutive stretches of NumPy samples, which the kernels read uncopied.

    The estimator may be a `Planar`, which takes `PlanarSample`s. Yields the state after each stretch, in which a member
    that is not finite has begun again, and the recorded leaves after each step. A ShapeError if the first samples do
    not fit the state.
    """
    from usvlearn.engine.external import first_pass, roll_both

    leaves, description = arrays_of(state), None if isinstance(estimator, Estimator) else estimator.description()
    own = None if description is None else first_pass(description, estimator, state)
    dtype = next(leaf.dtype for leaf in leaves.values() if leaf.dtype != bool)
    batch = next((leaf.shape[:-1] for name, leaf in leaves.items() if name in ("predictions", "surge.predictions")), ())
    device = next(tensors_in(state)).device
    for part in samples:
        part = tree_map(lambda x: x if x.dtype == bool else x.astype(dtype, copy=False), part)
        with torch.no_grad():
            if description is None:
                _check(state, whole := _moved(part, device))
                description = choose(estimator, state, whole, "auto") or {}
                own = first_pass(description, estimator, state)
            if description:
                leaves, _, kept = roll_both(own, description, leaves, part, False, record, torch.get_num_threads())
            else:
                state, _, named = rollout(estimator, state, _moved(part, device), record, backend="torch")
                leaves, kept = arrays_of(state), tree_map(array_of, named)
            leaves, told = afresh(leaves, lambda: arrays_of(estimator.init(batch)), own.ended if own else ())
            if told:
                warnings.warn(told, stacklevel=2)
            state = tree_of(state, leaves, device) if description or told else state
        yield state, kept


def tensors(samples: Sample, dtype: torch.dtype, device: torch.device | str = "cpu") -> Sample:
    """NumPy samples as tensors on a device: numbers of this dtype, masks of bool."""
    return tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, _moved(samples, device))


def _moved(samples: Sample, device: torch.device | str) -> Sample:
    """NumPy samples as tensors on a device."""
    return tree_map(lambda x: torch.from_numpy(x).to(device), samples)


def _run(
    estimator: Estimator, begin: State, steps: Step, pick: Callable[[State], Any] | None
) -> tuple[State, Tensor, Any]:
    """All steps by torch; leaves of `steps` are `(time, *batch)`."""
    state, predictions, records = begin, [], []
    for state, surge in walk(estimator, begin, steps):
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


def run(
    description: dict[str, Any], state: Any, samples: Sample, record: Record | None, free: bool, estimator: Any
) -> tuple[Any, Tensor, Any]:
    """`rollout`, or `simulate` (`free`), by the kernels."""
    from usvlearn.engine.external import first_pass, roll_both

    leaves, arrays, device = arrays_of(state), tree_map(array_of, samples), samples.surge.device
    first, steps = first_pass(description, estimator, state), len(arrays.surge)
    names = tuple(leaves) if callable(record) else tuple(record or ())
    if callable(record):
        steps = max(1, min(CHUNK, CELLS // sum(x.size for x in leaves.values())))
    parts, records, kept = [], [], dict[str, np.ndarray]()
    for begin in range(0, len(arrays.surge), steps):
        part = tree_map(lambda x, b=begin: x[b : b + steps], arrays)
        leaves, predictions, kept = roll_both(
            first, description, leaves, part, free, names, torch.get_num_threads(), device.type
        )
        parts.append(torch.as_tensor(predictions, device=device))
        if callable(record):
            states = ({name: x[k] for name, x in kept.items()} for k in range(len(predictions)))
            records += [record(tree_of(state, one, device)) for one in states]
    named = {name: torch.as_tensor(x, device=device) for name, x in kept.items()}
    recorded = stack(records) if callable(record) else None if record is None else named
    return tree_of(state, leaves, device), parts[0] if len(parts) == 1 else torch.cat(parts), recorded


def kernel_step(
    description: dict[str, Any], state: State, sample: Sample, given: Sequence[Tensor] = ()
) -> tuple[State, Tensor]:
    """The state after one sample, leaves `(*batch,)`, and the prediction, m/s, without gradients; see `protocol`."""
    from usvlearn.engine.run import roll

    device = sample.surge.device
    if sample.surge.numel() == 0:
        return state, sample.surge
    state, one = tree_map(_here, state), tree_map(lambda x: _here(x)[None], sample)
    if obstacle := out_of_reach([*tensors_in(state), *tensors_in(one)]):
        raise ConfigError(
            f"{obstacle}, and kernels make this step: for steps by torch alone, an Ensemble needs watched=False, "
            "conditional=False and no forecasts"
        )
    handed = np.stack([array_of(_here(x)) for x in given], -1)[None] if given else None
    leaves, threads = arrays_of(state), torch.get_num_threads()
    result = roll(description, leaves, tree_map(array_of, one), threads=threads, given=handed)
    return tree_of(state, leaves | result.leaves, device), torch.as_tensor(result.predictions[0], device=device)


def _here(x: Tensor) -> Tensor:
    return x.detach().cpu()


def kernel_forecast(description: dict[str, Any], state: State, inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Predictions and half-widths of a plan, m/s, `(time, *batch)`, of a described ensemble, without gradients."""
    from usvlearn.engine.single_steps import CompiledStepper

    arrays = CompiledStepper(description, arrays_of(state)).forecast(Inputs(*map(array_of, inputs)))
    surge, width = (torch.as_tensor(x, device=inputs.dt.device) for x in arrays)
    return surge, width


def stack(trees: Sequence[Any]) -> Any:
    """Trees of tensors as one, with a first axis that counts them."""
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)
