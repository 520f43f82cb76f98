"""The types that all packages share: what an estimator sees; and functions over the leaves of a state.

Only numpy is imported: the same types contain NumPy arrays (logs, a boat without torch) or torch tensors (estimators).
A *tree* is an array or tensor, a NamedTuple of trees, or a dict of trees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from html import escape
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ShapeError

Array = Any  # numpy.ndarray or torch.Tensor


class Inputs(NamedTuple):
    """Everything that a prediction may use. Leaves are `(*batch,)`.

    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
    >>> inputs._replace(dt=0.2)
    Inputs(command_left=0.5, command_right=0.5, heading=0.0 rad, yaw_rate=0.0 rad/s, dt=0.2 s)
    """

    command_left: Array  # xi_L in force over the step, share of full scale, -1 ... 1
    command_right: Array  # xi_R, likewise a share
    heading: Array  # rad, 0 north, clockwise
    yaw_rate: Array  # rad/s
    dt: Array  # s since the previous step; 0 starts a segment (see `Sample`)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map('='.join, _with_units(self)))})"

    def _repr_html_(self) -> str:
        return html_table(_with_units(self))


LIMIT = 10.0  # m/s; the default of every limit of a speed
PLAUSIBLE = 100.0  # m/s; a speed at or beyond it counts as bad data. The next line is the same for the inputs
PLAUSIBLE_INPUTS = Inputs(command_left=100.0, command_right=100.0, heading=1e6, yaw_rate=100.0, dt=1e4)


class Sample(NamedTuple):
    """One aligned time step. Leaves are `(*batch,)`, or `(time, *batch)` for a run.

    `fresh` says that the inputs are recent: only then a speed is predicted. `measured` says that the speed is, too:
    only then it is learned from; it implies `fresh`. A loop at 10 Hz beside a GPS at 5 Hz makes 10 fresh samples a
    second, and every second one is measured. If the GPS is silent, samples stay fresh and are only predicted. If the
    commands stop coming, none is fresh, and the state waits.

    A sample whose `inputs.dt` is 0 makes no step: it starts a segment (the start of a run, the end of an outage), and
    its speed is the one from which the next step departs.

    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.1)
    >>> for surge in (1.2, None, 1.3, None):  # what the GPS gave since the last step of the loop
    ...     got = surge is not None
    ...     sample = Sample(inputs, surge if got else float("nan"), fresh=True, measured=got)
    """

    inputs: Inputs  # of the step
    surge: Array  # measured forward speed at the end of the step, m/s; NaN where there was none
    fresh: Array  # bool: every input arrived inside its staleness window
    measured: Array  # bool: `fresh`, and the speed arrived inside its window

    __repr__, _repr_html_ = Inputs.__repr__, Inputs._repr_html_  # type: ignore[misc]  # mypy expects fields alone


class PlanarSample(NamedTuple):
    """One aligned time step of a boat that turns: the surge's sample, and what was measured at the end of the step.

    Each number is NaN where none arrived inside its window, so that each has its own freshness.

    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
    >>> sample = Sample(inputs, surge=1.2, fresh=True, measured=True)
    >>> PlanarSample(sample, heading=0.1, yaw_rate=0.0, sway=0.0, north=3.0, east=0.3).north
    3.0
    """

    sample: Sample  # of the surge
    heading: Array  # rad, 0 north, clockwise
    yaw_rate: Array  # rad/s, clockwise
    sway: Array  # m/s over ground, to starboard
    north: Array  # m, of the boat's position on a plane
    east: Array  # m


class VectorSample(NamedTuple):
    """One aligned time step of several components of the velocity: surge, sway and yaw rate, or some of them.

    The components come last, after the axes of the other leaves. A sample whose `inputs.dt` is 0 starts a segment, as
    of `Sample`. `inputs.yaw_rate` is not used where the yaw rate is a component.

    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
    >>> VectorSample(inputs, np.array([1.2, 0.0, 0.1]), fresh=True, measured=np.ones(3, bool)).velocity.shape
    (3,)
    """

    inputs: Inputs  # of the step
    velocity: Array  # (..., components) at the end of the step, m/s, m/s, rad/s; NaN where there was none
    fresh: Array  # bool: every input arrived inside its staleness window
    measured: Array  # (..., components) bool: and the component did


UNITS = {  # of a run's time, and of all fields of its samples
    "time": "s", "command_left": "share of full scale", "command_right": "share of full scale",
    "heading": "rad, 0 north, clockwise", "yaw_rate": "rad/s", "dt": "s", "surge": "m/s", "fresh": "bool",
    "measured": "bool",
}  # fmt: skip


def _with_units(fields: Inputs | Sample) -> list[tuple[str, str]]:
    """Name and value of each number of inputs or of a sample, with its unit; of arrays the shape."""
    pairs = []
    for path, leaf in named_leaves(fields):
        name, shape = path.rpartition(".")[2], np.shape(leaf)
        unit = UNITS[name].partition(",")[0]
        value = f"array {shape}" if shape else f"{leaf}"
        pairs.append((name, f"{value} {unit}" if unit in ("rad", "rad/s", "s", "m/s") else value))
    return pairs


def html_table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values as a table for a notebook."""
    return (
        f"<table>{''.join(f'<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>' for name, value in rows)}</table>"
    )


def why_no_step(sample: Sample, surge_limit: float = PLAUSIBLE) -> str:
    """Why `masks` lets a sample of one vehicle make no step, in words; "" if it makes one."""
    inputs = sample.inputs
    if inputs.dt == 0:
        known = abs(sample.surge) < surge_limit
        return f"dt is 0: the sample starts a segment{'' if known else ', but it has no speed to start from'}"
    if not sample.fresh:
        return "fresh is False: an input was too old to predict with"
    for name, x, limit in zip(Inputs._fields, inputs, PLAUSIBLE_INPUTS, strict=True):
        if not abs(x) < limit or (name == "dt" and x < 0):
            return f"{name} is {x}, expected {'0' if name == 'dt' else f'-{limit:g}'} to {limit:g}"
    return ""


def speed_limit(top: float) -> float:
    """The limit of all speeds, measured and predicted, of a boat with this top speed, m/s."""
    return max(LIMIT, 1.25 * top)


class Masks(NamedTuple):
    """What each sample is used for. Leaves are bool, `(*batch,)`."""

    steps: Array  # a step is made, and its speed predicted
    learns: Array  # and learned from; these are the steps that count in every error and score
    starts: Array  # a segment is opened at the measured speed
    known: Array  # the speed is a number below the limit


def masks(sample: Sample, surge_limit: float = PLAUSIBLE) -> Masks:
    """Decide which steps are made, learned from and scored; NumPy arrays and tensors `(*batch,)` or `(time, *batch)`.

    An input that is not finite or not plausible makes no step. A speed counts as missing where it is not finite, or
    reaches the limit, m/s. The compiled twin is `usvlearn.core.prepared_samples.prepare`.
    """
    known, dt = abs(sample.surge) < surge_limit, sample.inputs.dt
    steps = sample.fresh & (dt > 0)
    for x, limit in zip(sample.inputs, PLAUSIBLE_INPUTS, strict=True):
        steps = steps & (abs(x) < limit)
    return Masks(steps, steps & sample.measured & known, (dt == 0) & known, known)


class Run(NamedTuple):
    """A mission of one boat, or of a fleet with one batch element per boat, on the grid of `dt`.

    >>> one = np.ones((3, 1))
    >>> samples = Sample(Inputs(one, one, 0 * one, 0 * one, 0.4 * one), one, one > 0, one > 0)
    >>> Run(0.4 * np.arange(3.0)[:, None], samples, names=("001",), lengths=(3,)).time[-1]
    array([0.8])
    """

    time: np.ndarray  # (time, boats) s since each log's first step; NaN where padded
    samples: Sample  # leaves (time, *batch)
    names: tuple[str, ...]  # the run's name per boat; "" for a boat that had no such run
    lengths: tuple[int, ...]  # number of steps per boat; the steps after them are padding, never fresh
    position: np.ndarray | None = None  # (time, boats, 2) m north and east of the first; NaN where unknown
    poses: np.ndarray | None = None  # (time, boats, 5) of a `PlanarSample`: rad, rad/s, m/s, m, m; NaN likewise

    @property
    def planar(self) -> PlanarSample:
        """The samples with the poses; NaN where there are none."""
        none = np.broadcast_to(np.nan, (*self.samples.surge.shape, len(PlanarSample._fields) - 1))
        return PlanarSample(self.samples, *np.moveaxis(none if self.poses is None else self.poses, -1, 0))


class Fleet(NamedTuple):
    """All runs of all boats, in the order in which they are replayed.

    >>> one = np.ones((3, 1))
    >>> samples = Sample(Inputs(one, one, 0 * one, 0 * one, 0.4 * one), one, one > 0, one > 0)
    >>> run = Run(0.4 * np.arange(3.0)[:, None], samples, names=("001",), lengths=(3,))
    >>> fleet = Fleet(("heron",), (run, run), {})
    >>> fleet.steps, fleet.steps_before(1, step=2)
    (6, 5)
    """

    boats: tuple[str, ...]  # their names, in the order of the batch
    runs: tuple[Run, ...]  # samples are (time, boats)
    rejected: dict[str, dict[str, dict[str, int]]]  # boat -> channel -> cause -> count

    def steps_before(self, run: int, step: int = 0) -> int:
        """Steps of all earlier runs, and of one run before a step.

        Args:
            run: index of the run.
            step: index of the step in it.

        Returns:
            The number of steps.
        """
        return sum(len(one.time) for one in self.runs[:run]) + step

    @property
    def steps(self) -> int:
        """The number of steps of all runs together; each run counts its longest boat."""
        return self.steps_before(len(self.runs))


def check_inputs(inputs: Inputs, batch: tuple[int, ...] = ()) -> None:
    """Raise a TypeError unless all fields are numbers or arrays of them; a ShapeError where one fits no batch.

    One number fits every batch, with any number of axes.
    """
    for name, value in zip(Inputs._fields, inputs, strict=True):
        _check_field(name, value, "biuf", "a number", batch)


def check_sample(sample: Sample | PlanarSample, batch: tuple[int, ...] = ()) -> None:
    """Check the inputs and what is measured as `check_inputs` does; `fresh` and `measured` are bools or integers."""
    measured = {}
    if isinstance(sample, PlanarSample):
        measured, sample = sample._asdict(), sample.sample
        del measured["sample"]
    check_inputs(sample.inputs, batch)
    for name, value in {"surge": sample.surge, **measured}.items():
        _check_field(name, value, "biuf", "a number (NaN where there is none)", batch)
    for name in ("fresh", "measured"):
        _check_field(name, getattr(sample, name), "biu", "True or False", batch)


def one_number(value: Any) -> Any:
    """The Python number or bool in an array, a list or a tensor of one element; other values unchanged."""
    if isinstance(value, list | tuple):
        value = np.asarray(value)
    return value.item() if hasattr(value, "item") and np.prod(np.shape(value)) == 1 else value


def _check_field(name: str, value: Any, kinds: str, expected: str, batch: tuple[int, ...]) -> None:
    if _kind(value) not in kinds:
        raise TypeError(f"{name}: found {value!r:.80}, expected {expected}")
    shape = np.shape(value)
    if np.prod(shape) == 1:
        return
    fits = all(length in (1, wide) for length, wide in zip(reversed(shape), reversed(batch), strict=False))
    if len(shape) > len(batch) or not fits:
        raise ShapeError(f"{name}: found the shape {tuple(shape)}, expected one number or the batch {batch}")


def _kind(value: Any) -> str:
    """NumPy's `dtype.kind` of a value; "O" if it is neither a number nor an array or tensor of numbers."""
    if isinstance(value, bool):
        return "b"
    if isinstance(value, Integral):
        return "i" if abs(int(value)) < 10**300 else "O"  # beyond any float
    if isinstance(value, Real):
        return "f"
    if isinstance(value, np.ma.MaskedArray):
        return "O"  # a masked value is not a number
    if isinstance(value, list | tuple):
        kinds = {_kind(each) for each in value}
        return "i" if kinds <= set("biu") else "f" if kinds <= set("biuf") else "O"
    dtype = getattr(value, "dtype", None)
    if isinstance(dtype, np.dtype):
        return dtype.kind
    return {"bool": "b", "int": "i", "uint": "u", "float": "f", "bfloat": "f"}.get(sort_of(dtype), "O")


def sort_of(dtype: Any) -> str:
    """The name of a dtype of NumPy or torch without its size."""
    return str(dtype).removeprefix("torch.").rstrip("0123456789")


def tree_map(f: Callable[..., Any], *trees: Any) -> Any:
    """Apply `f` to corresponding leaves of equally structured trees."""
    first = trees[0]
    if isinstance(first, dict):
        return {key: tree_map(f, *(tree[key] for tree in trees)) for key in first}
    if isinstance(first, tuple):
        return type(first)(*(tree_map(f, *children) for children in zip(*trees, strict=True)))
    return f(*trees)


def named_leaves(tree: Any, name: str = "") -> Iterator[tuple[str, Array]]:
    """Yield every leaf with its dotted path."""
    if isinstance(tree, dict):
        items: Iterable[tuple[str, Any]] = tree.items()
    elif isinstance(tree, tuple):
        items = tree._asdict().items()  # type: ignore[attr-defined]  # a NamedTuple, of which there is no common class
    else:
        yield name, tree
        return
    for key, child in items:
        yield from named_leaves(child, f"{name}.{key}" if name else key)


def rebuild(template: Any, leaves: dict[str, Array], name: str = "") -> Any:
    """The inverse of `named_leaves`: a tree shaped like `template` from leaves by dotted path."""
    names = iter([path for path, _ in named_leaves(template, name)])
    return tree_map(lambda _: leaves[next(names)], template)


def where(mask: Array, new: Array, old: Array) -> Array:
    """`new` where `mask`, else `old`; `mask` is `(*batch,)`, the others are `(*batch, ...)`."""
    if new is old:
        return old
    mask = mask.reshape(mask.shape + (1,) * (new.ndim - mask.ndim))
    if isinstance(mask, np.ndarray):
        return np.where(mask, new, old)
    return new.where(mask, old)
