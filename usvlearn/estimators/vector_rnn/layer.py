"""The network of several components in torch: equations (1) to (4) of `state`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from certify.networks.vector import VectorWeights
from certify.training.vector_projections import CONDITIONS, project
from certify.training.vector_rates import rate
from usvlearn.core.hyper import Hyper, Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.core.samples import Inputs, VectorSample, tree_map, where
from usvlearn.errors import ConfigError, check_choice, check_positive
from usvlearn.estimators.rnn.kept import whole
from usvlearn.estimators.rnn.layer import clipped
from usvlearn.estimators.rnn.state import STRIDE, TURN
from usvlearn.estimators.vector_rnn.equations import gradient, initial_weights, network
from usvlearn.estimators.vector_rnn.samples import added, masks
from usvlearn.estimators.vector_rnn.state import (
    BETA2,
    COAST_LIMIT,
    EPSILON,
    MOST_KEPT,
    MOST_NEURONS,
    MOST_WINDOWS,
    Kept,
    NetworkWeights,
    VectorRNNState,
)
from usvlearn.estimators.vector_rnn.vector_checks import check_samples, check_width, listed, write_npz


class VectorRNN(nn.Module):
    """Shallow ReLU network of surge, sway and yaw rate that contracts while it learns; n = 20 neurons by default.

    Its verbs are those of an `Estimator`, for a velocity of several components in place of the surge.

    The network is the paper's, section IV-B, for several components; Adam is that of Kingma & Ba 2015. The projection
    is derived in `docs/certification.md`.

    Args:
        maxima: v_max of each component, m/s, m/s, rad/s, by which it is divided. Their number is q.
        neurons: n, the number of neurons.
        heading: whether sin θ and cos θ are inputs, beside the commands.
        rate: Adam's learning rate at the first update, no unit; broadcasts against the batch.
        rate_ratio: relative rates, no unit, of R, A, W, W₂ and b; those of W and W₂ also scale the initial neurons.
        decay: the rate falls as 1/√(1 + ⌊k/decay⌋) after a number of k updates; None keeps it.
        clip: the norm that no batch element's gradient exceeds, no unit; None for no limit.
        stability: "project" onto `condition` after every update, or "none".
        condition: "exact" (all activation patterns, in the norm (4)) or "gershgorin" (the paper's lemma).
        contraction_rate: κ, no unit; broadcasts against the batch.
        scaling: t of (4), `(q,)`; ones by default. `certify.search.vector_scaling` finds one.
        importance: of the squared error of each divided component in the loss, `(q,)`; ones by default.
        kept: M, the number of samples that are kept.
        window: H, the number of steps of an open-loop simulation in the loss.
        windows: B, the number of windows, of which all but one are learned again.
        seed: seed of the initial neurons.

    Raises:
        ConfigError: an argument outside its range.

    >>> rnn = VectorRNN(maxima=(2.7, 0.5, 1.0))
    >>> state, dt = rnn.init(), torch.tensor(0.2)
    >>> velocity, one = torch.tensor([1.0, 0.0, 0.1]), torch.tensor(1.0)
    >>> state = rnn.start(state, velocity.double())
    >>> rnn.predict(state, Inputs(one, one, 0 * one, 0 * one, dt))[1].detach()
    tensor([0.9990, 0.0000, 0.0999], dtype=torch.float64)
    """

    maxima: Tensor  # (q,)
    scaling: Tensor  # (q,)
    importance: Tensor  # (q,)
    ratio: Tensor  # (parameters,) in the order of the gradient

    def __init__(
        self,
        maxima: Sequence[float] = (3.0, 1.0, 1.5),
        neurons: int = 20,
        heading: bool = False,
        rate: Hyper = 8e-4,
        rate_ratio: Sequence[float] = (0.3, 0.3, 1.0, 1.0, 1.0),
        decay: int | None = 1000,
        clip: float | None = 0.1,
        stability: str = "project",
        condition: str = "exact",
        contraction_rate: Hyper = 0.999,
        scaling: Sequence[float] | None = None,
        importance: Sequence[float] | None = None,
        kept: int = 1000,
        window: int = 10,
        windows: int = 8,
        seed: int = 0,
    ):
        super().__init__()
        given = listed("maxima", maxima, "one for each of 1 to 6 components")
        top = [check_positive("maxima", each, "of m/s or rad/s") for each in given]
        q, m = len(top), 4 if heading else 2
        if not 1 <= q <= 6:
            raise ConfigError(f"maxima: found {q} numbers, expected one for each of 1 to 6 components")
        for name, value, least, most in (
            ("neurons", neurons, 2 * m + 1, MOST_NEURONS),
            ("kept", kept, 1, MOST_KEPT),
            ("window", window, 1, kept),
            ("windows", windows, 1, MOST_WINDOWS),
            ("seed", seed, 0, 2**63 - 1),
        ):
            if isinstance(value, bool) or not (isinstance(value, int) and least <= value <= most):
                raise ConfigError(f"{name}: found {value!r}, expected a whole number, {least} … {most}")
        self.decay = None if decay is None else check_positive("decay", decay, "of updates")
        self.clip = None if clip in (None, math.inf) else check_positive("clip", clip, ", or null for no limit")
        check_choice("stability", stability, ("none", "project"))
        self.condition = check_choice("condition", condition, CONDITIONS)
        t, g = (
            [check_positive(name, each) for each in listed(name, [1.0] * q if x is None else x, f"{q}, as maxima has")]
            for name, x in (("scaling", scaling), ("importance", importance))
        )
        if len(t) != q or (condition == "gershgorin" and scaling is not None):
            expected = "none for gershgorin" if condition == "gershgorin" else f"{q} numbers, as maxima has"
            raise ConfigError(f"scaling: found {len(t)} numbers, expected {expected}")
        if len(g) != q:
            raise ConfigError(f"importance: found {len(g)} numbers, expected {q}, as maxima has")
        self.heading, self.kept, self.window, self.windows = bool(heading), kept, window, windows
        self.rate, kappa = Positive(rate, "rate"), UnitInterval(contraction_rate, "contraction_rate")
        self.initial_rate = float(kappa().detach().min())
        self.contraction_rate = kappa if stability == "project" else None
        self.register_buffer("maxima", as_tensor(top))
        self.register_buffer("scaling", as_tensor(t))
        self.register_buffer("importance", as_tensor(g))
        ratio = as_tensor(listed("rate_ratio", rate_ratio, "five of 0 or more"), "rate_ratio")
        if ratio.shape != (5,) or not bool(((ratio >= 0) & ratio.isfinite()).all()):
            raise ConfigError(f"rate_ratio: found {list(rate_ratio)}, expected five numbers of 0 or more")
        weights = initial_weights(q, m, neurons, ratio, torch.Generator().manual_seed(seed))
        self.R, self.A, self.W, self.W2, self.b = map(nn.Parameter, weights)
        flat = [each.expand(w.numel()) for each, w in zip(ratio, weights, strict=True)]
        self.register_buffer("ratio", torch.cat(flat))

    @property
    def _initial(self) -> NetworkWeights:
        return NetworkWeights(self.R, self.A, self.W, self.W2, self.b)

    def init(self, batch: Sequence[int] = ()) -> VectorRNNState:
        """The state before the first sample.

        Args:
            batch: its shape, a count for each axis; () for one vehicle.

        Returns:
            The state, leaves `(*batch, …)`.

        Raises:
            ShapeError: a hyperparameter does not broadcast against the batch.
        """
        batch, zero = tuple(batch), self.R.new_zeros
        check_broadcast(self, batch)
        weights = NetworkWeights(*(w.expand(*batch, *w.shape) for w in self._initial))
        kappa = self.R.new_full((), self.initial_rate) if self.contraction_rate is None else self.contraction_rate()
        weights = self._stable(weights._replace(R=weights.R * kappa[..., None, None]))
        q, m, M = len(self.maxima), self.W2.shape[-1], self.kept
        samples = Kept(zero(*batch, M, q), zero(*batch, M, m), zero(*batch, M, q), zero(*batch, M, q), zero(*batch, M),
                       zero(batch), zero(batch))  # fmt: skip
        unbroken = torch.zeros(batch, dtype=torch.bool, device=self.R.device)
        return VectorRNNState(weights, zero(*batch, len(self.ratio)), zero(batch), zero(*batch, q), unbroken, samples)

    def network_inputs(self, inputs: Inputs) -> Tensor:
        """u of (1).

        Args:
            inputs: leaves `(*batch,)`.

        Returns:
            `(*batch, 2)`, or `(*batch, 4)` with the heading.

        >>> one = torch.tensor(1.0)
        >>> VectorRNN(heading=True).network_inputs(Inputs(one, one, 0 * one, one, one))
        tensor([1., 1., 0., 1.])
        """
        u = [inputs.command_left, inputs.command_right]
        return torch.stack([*u, inputs.heading.sin(), inputs.heading.cos()] if self.heading else u, -1)

    def predict(self, state: VectorRNNState, inputs: Inputs) -> tuple[VectorRNNState, Tensor]:
        """Time update: one step on, without learning.

        Args:
            state: before the step.
            inputs: of the step, leaves `(*batch,)`.

        Returns:
            The state after the step, and the predicted velocity, m/s, m/s, rad/s, `(*batch, q)`.
        """
        x, _ = network(state.weights, state.velocity / self.maxima, self.network_inputs(inputs).to(self.maxima))
        return state._replace(velocity=self._limited(x), unbroken=torch.zeros_like(state.unbroken)), x * self.maxima

    def update(
        self, state: VectorRNNState, inputs: Inputs, velocity: Tensor, measured: Tensor | None = None
    ) -> VectorRNNState:
        """Learn from a velocity, `(*batch, q)`; a component that was not measured is left as predicted.

        Args:
            state: the one that was given to `predict`.
            inputs: leaves `(*batch,)`.
            velocity: measured at the end of the step, m/s, m/s, rad/s, `(*batch, q)`; finite.
            measured: `(*batch, q)` bool; all by default.

        Returns:
            The state after the step.

        Raises:
            ShapeError: another number of components.

        >>> rnn, one = VectorRNN(maxima=(3.0,)), torch.tensor(1.0).double()
        >>> inputs = Inputs(one, one, 0 * one, 0 * one, 0.4 * one)
        >>> state = rnn.update(rnn.init(), inputs, 2 * one[None])
        >>> state.velocity.item()
        2.0
        """
        check_width("velocity", velocity, len(self.maxima))
        if measured is not None:
            check_width("measured", measured, len(self.maxima))
        return self._learn(state, inputs, velocity, measured)

    def _learn(
        self, state: VectorRNNState, inputs: Inputs, velocity: Tensor, measured: Tensor | None
    ) -> VectorRNNState:
        x, u = state.velocity / self.maxima, self.network_inputs(inputs).to(self.maxima)
        weight = torch.ones_like(x) if measured is None else measured.to(x).expand_as(x)
        predicted, _ = network(state.weights, x, u)
        target = velocity / self.maxima * weight
        kept = added(state.kept, (x, u, target, weight * self.importance, state.unbroken.to(x)))
        windows, kept = self._windows(kept)
        found = gradient(state.weights, windows)
        learned = self._descend(state, found if self.clip is None else clipped(found, self.clip))
        after = torch.where(weight > 0, velocity, self._limited(predicted))
        return learned._replace(velocity=after, unbroken=torch.ones_like(state.unbroken), kept=kept)

    def start(self, state: VectorRNNState, velocity: Tensor) -> VectorRNNState:
        """The state with a velocity from which the next step departs; nothing is learned.

        Args:
            state: before.
            velocity: m/s, m/s, rad/s, `(*batch, q)`.

        Returns:
            The state that has this velocity.

        Raises:
            ShapeError: another number of components.
        """
        check_width("velocity", velocity, len(self.maxima))
        return state._replace(velocity=velocity, unbroken=torch.zeros_like(state.unbroken))

    def forward(self, state: VectorRNNState, sample: VectorSample) -> tuple[VectorRNNState, Tensor]:
        """Learn from what was measured, coast where nothing was, hold where inputs are stale, start a segment.

        Returns the next state and the predicted velocity, `(*batch, q)`: NaN where no step was made.
        """
        steps, known, starts = masks(sample)
        measured = known & sample.measured & steps[..., None]
        inputs = Inputs(*(torch.where(steps, x, 0.0) for x in sample.inputs))
        velocity = torch.where(known, sample.velocity, 0.0).to(self.maxima)
        coasted, predicted = self.predict(state, inputs)
        learned = self._learn(state, inputs, torch.where(measured, velocity, 0.0), measured)
        started = self.start(state, torch.where(known, velocity, state.velocity))
        for mask, tree in ((steps, coasted), (measured.any(-1), learned), (starts, started)):
            state = tree_map(lambda new, old, mask=mask: where(mask, new, old), tree, state)
        return state, torch.where(steps[..., None], predicted, math.nan)

    def rollout(
        self, state: VectorRNNState, samples: VectorSample, learn: bool = True
    ) -> tuple[VectorRNNState, Tensor]:
        """Run over samples, predicting before learning; or free, from the inputs alone.

        Args:
            state: leaves `(*batch, …)`.
            samples: leaves `(time, *batch)`, and `(time, *batch, q)`.
            learn: False for an open-loop simulation: the velocity is taken only where a segment starts, and nothing is
                learned.

        Returns:
            The last state, and the predictions, `(time, *batch, q)`, NaN where no step was made.

        Raises:
            ShapeError: no sample, NumPy arrays, or another number of components or batch than the state's.

        >>> t = torch.ones(200, dtype=torch.float64)
        >>> every = torch.ones(200, 1, dtype=torch.bool)
        >>> samples = VectorSample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t[:, None], t > 0, every)
        >>> rnn = VectorRNN(maxima=(3.0,), kept=50)
        >>> state, predicted = rnn.rollout(rnn.init(), samples)
        >>> bool((predicted[-1] - 1.5).abs() < 0.05)
        True
        """
        check_samples(state, samples, len(self.maxima))
        if not learn:
            samples = samples._replace(measured=torch.zeros_like(samples.measured))
        predictions = []
        for k in range(len(samples.velocity)):
            sample = tree_map(lambda x, k=k: x[k], samples)
            state, predicted = self(state, sample) if learn else self._free(state, sample)
            predictions.append(predicted)
        return state, torch.stack(predictions)

    def _free(self, state: VectorRNNState, sample: VectorSample) -> tuple[VectorRNNState, Tensor]:
        """`forward` where nothing is measured but at the start of a segment, without the cost of an update."""
        steps, known, starts = masks(sample)
        inputs = Inputs(*(torch.where(steps, x, 0.0) for x in sample.inputs))
        coasted, predicted = self.predict(state, inputs)
        velocity = torch.where(steps[..., None], coasted.velocity, state.velocity)
        velocity = torch.where(starts[..., None] & known, sample.velocity.to(velocity), velocity)
        unbroken = state.unbroken & ~(steps | starts)
        predicted = torch.where(steps[..., None], predicted, math.nan)
        return state._replace(velocity=velocity, unbroken=unbroken), predicted

    def monitor(self, state: VectorRNNState) -> dict[str, Tensor]:
        """The exact rate of the weights in the norm (4).

        Args:
            state: of this network.

        Returns:
            `contraction_rate`, `(*batch,)`, no unit.

        >>> round(VectorRNN().monitor(VectorRNN().init())["contraction_rate"].item(), 3)
        0.999
        """
        return {"contraction_rate": rate(VectorWeights(*state.weights), self.scaling.diag())}

    def save(self, state: VectorRNNState, path: str | Path) -> Path:
        """Write the weights as .npz, the only format, for `certify.networks.vector.load`; with `maxima` and `scaling`.

        The suffix .npz is added where it is missing, and folders are made.

        Args:
            state: of this network; `load` finds one network for each element of its batch.
            path: of the file.

        Returns:
            The path of the file.

        Raises:
            ConfigError: the file cannot be written; an older one of this name is then unchanged.

        >>> from tempfile import TemporaryDirectory
        >>> from certify.networks.vector import load
        >>> rnn = VectorRNN(neurons=8)
        >>> with TemporaryDirectory() as folder:
        ...     load(rnn.save(rnn.init(), f"{folder}/net"))[0].neurons
        8
        """
        arrays = state.weights._asdict() | {"maxima": self.maxima, "scaling": self.scaling}
        return write_npz(path, {name: x.detach().cpu().numpy() for name, x in arrays.items()})

    def _limited(self, x: Tensor) -> Tensor:
        """The velocity from which a step departs that no measurement has corrected."""
        return x.clamp(-COAST_LIMIT, COAST_LIMIT) * self.maxima

    def _stable(self, weights: NetworkWeights) -> NetworkWeights:
        if self.contraction_rate is None:
            return weights
        scaling = self.scaling if self.condition == "exact" else None
        return NetworkWeights(
            *project(VectorWeights(*weights), self.contraction_rate(), scaling, self.condition)[: len(weights)]
        )

    def _windows(self, kept: Kept) -> tuple[Kept, Kept]:
        """The windows to be learned, leaves `(*batch, B, H, …)`, and the samples with the counter moved on."""
        M, H, device = self.kept, self.window, kept.turn.device
        count = whole(kept.learned, 2 * M)[..., None]
        filled = count.clamp(max=M)
        turns = whole(kept.turn, TURN)[..., None] + STRIDE * torch.arange(self.windows, device=device)
        ends = torch.cat([torch.zeros_like(count), turns[..., :-1] % TURN * filled // TURN], -1)  # age, (*batch, B)
        ages = ends[..., None] + torch.arange(H - 1, -1, -1, device=device)  # (*batch, B, H)
        there = ages < filled[..., None]
        place = ((count[..., None] - 1 - ages) % M).flatten(-2)

        def at(rows: Tensor) -> Tensor:
            index = place if rows.ndim == place.ndim else place[..., None]
            return rows.take_along_dim(index, place.ndim - 1).unflatten(place.ndim - 1, ages.shape[-2:])

        before, inputs, target, weight, successive = (at(rows) for rows in kept[:5])
        first = there.cumsum(-1) == 1  # nothing leads to the oldest sample that is kept
        successive = successive * (there & ~first)
        windows = Kept(before, inputs, target, weight * there[..., None], successive, kept.learned, kept.turn)
        return windows, kept._replace(turn=(turns[..., -1] % TURN).to(kept.turn))

    def _descend(self, state: VectorRNNState, grad: Tensor) -> VectorRNNState:
        """One step of Adam (Kingma & Ba 2015) without a mean of the gradient, and one projection."""
        step_size, count = self.rate(), state.updates + 1
        if self.decay is not None:
            step_size = step_size * (1 + (state.updates / self.decay).floor()).rsqrt()
        v = state.moment.lerp(grad * grad, 1 - BETA2)
        v_hat = v / (1 - BETA2**count)[..., None]
        step = step_size[..., None] * self.ratio * grad / (v_hat.clamp(min=torch.finfo(v.dtype).tiny).sqrt() + EPSILON)
        parts = step.split([w.numel() for w in self._initial], -1)
        moved = (w - d.reshape(w.shape) for w, d in zip(state.weights, parts, strict=True))
        return state._replace(weights=self._stable(NetworkWeights(*moved)), moment=v, updates=count)
