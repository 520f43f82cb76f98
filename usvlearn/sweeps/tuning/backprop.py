"""Hyperparameters by gradient: truncated back-propagation through the online run, with one batch element per run.

It is for parameters that are too many for `sensitivities`: the thousands of initial weights of a network. For a gain
with a long memory, a truncated gradient is biased.

Every run of every boat is a batch element, `(time, runs)`. A batch element starts from the state that the boat has at
that run when all runs are replayed in order with the present hyperparameters. The first run starts from `init`, so that
the gradient reaches the initial state. The loss of a window is its share of the objective,

    L = Σ_elements w Σ_k |v_k − v̂_k|,   w = 1/(boats · measured steps of the batch element's boat)                  (1)

so that the losses of an epoch add up to the MAE, averaged over boats. After each window Adam (Kingma & Ba 2015) makes a
step on the scale of each hyperparameter (logarithm or logit), within its range, and the gradient is truncated.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.protocol import Estimator, clean
from usvlearn.core.samples import PLAUSIBLE, Fleet, Sample, masks, tree_map
from usvlearn.engine.rollouts import rollout, tensors
from usvlearn.errors import ConfigError, check_choice
from usvlearn.estimators.rnn.layer import RNN
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, element_errors

EPOCH_COST, PASS_COST = 3, 1  # evaluations: forward and backward through all samples; forward alone
RATE, WEIGHT_RATE = 0.1, 0.003  # Adam's, on the scale, and for initial weights; they fall to 0 at the last window
BETAS = (0.8, 0.98)
CLIP = 1.0  # of the gradient, in units of a window's share of the MAE: one outlier must not fill Adam's moments
WEIGHTS = ("a", "w1", "W2", "b")
STARTS = ("default", "middle")


class Lanes(NamedTuple):
    """All runs of a fleet, side by side."""

    samples: Sample  # (time, elements), padded with samples that are never fresh
    run: Tensor  # (elements,) index of each batch element's run
    boat: Tensor  # (elements,) index of its boat
    weight: Tensor  # (elements,) w of (1)


def run_elements(fleet: Fleet, like: Tensor, surge_limit: float = PLAUSIBLE) -> Lanes:
    """Every run of every boat as a batch element, of the dtype and device of `like`; `surge_limit`, m/s, is the
    estimator's.
    """
    longest, boats = max(len(run.time) for run in fleet.runs), len(fleet.boats)

    def padded(x: Tensor) -> Tensor:
        fill = math.nan if x.is_floating_point() else False
        return torch.cat([x, x.new_full((longest - len(x), boats), fill)])

    runs = [tree_map(padded, tensors(run.samples, like.dtype, like.device)) for run in fleet.runs]
    samples = tree_map(lambda *x: torch.cat(x, 1), *runs)
    lengths = torch.tensor([length for run in fleet.runs for length in run.lengths])
    there = lengths.nonzero()[:, 0].to(like.device)
    run, boat = there // boats, there % boats
    steps = masks(samples, surge_limit).learns.sum(0).reshape(-1, boats).sum(0)  # per boat
    weight = (1 / (boats * steps.to(like.dtype)))[boat]
    return Lanes(tree_map(lambda x: x[:, there], samples), run, boat, weight)


def window_losses(
    estimator: Estimator, elements: Lanes, starts: Sequence[Any], boats: int, window: int
) -> Iterator[tuple[Tensor, float]]:
    """The loss (1) of each window, and its share of all steps; the hyperparameters may change between windows.

    Args:
        estimator: its hyperparameters receive the gradient.
        batch elements: see `run_elements`.
        starts: the states at the start of each run, leaves `(boats, ...)`; the first is recomputed, with gradient.
        boats: their number.
        window: steps.
    """
    place = elements.run * boats + elements.boat
    states = [estimator.init((boats,)), *starts[1:]]
    state = tree_map(lambda *x: torch.cat(x)[place], *states)
    limit = estimator.surge_limit
    total = masks(elements.samples, limit).learns.sum()
    for begin in range(0, len(elements.samples.surge), window):
        part = tree_map(lambda x, a=begin: x[a : a + window], elements.samples)
        step = clean(part, limit)
        state, predicted, _ = rollout(estimator, state, part)
        errors = torch.where(step.learns, (predicted - step.surge).abs(), 0.0)
        yield (errors * elements.weight).sum(), float(step.learns.sum() / total)
        state = tree_map(Tensor.detach, state)


class Fitted(NamedTuple):
    """The result of learning by gradient."""

    evaluations: list[Evaluation]  # the default first, then one for each epoch
    used: int  # evaluations used, without the default
    curve: list[dict[str, float]]  # per window: the loss as MAE, m/s, and the hyperparameters


def fit(
    objective: Objective,
    parameters: Sequence[Hyperparameter],
    evaluations: int,
    window: int = 100,
    start: str = "default",
    folder: str | Path = ".",
) -> Fitted:
    """Learn hyperparameters by gradient, starting from the default, or from the middle of the ranges.

    An epoch costs four evaluations: three for forward and backward through all samples, one for the pass that evaluates
    the result and gives the states from which the next epoch starts. The best of all passes is the result.

    Args:
        objective: evaluates settings, and makes the estimator.
        parameters: the learned hyperparameters; initial weights of a network are possible, too.
        evaluations: the budget.
        window: steps after which the gradient is cut.
        start: "default" or "middle".
        folder: for the files of initial weights, one for each epoch.

    Raises:
        ConfigError: fewer evaluations than an epoch costs, or an unknown start.
    """
    check_choice("tuning.start", start, STARTS)
    if isinstance(window, bool) or not isinstance(window, int) or window < 1:
        raise ConfigError(f"tuning.window: found {window!r}, expected a whole number of steps, 1 or more")
    extra = PASS_COST * (start == "middle")  # one more pass to evaluate it
    if (epochs := (evaluations - extra) // (EPOCH_COST + PASS_COST)) < 1:
        least = EPOCH_COST + PASS_COST + extra
        raise ConfigError(f"tuning.evaluations: found {evaluations}, expected {least} or more, the cost of learn")
    (default,) = objective([{each.path: each.default for each in parameters if each.kind is not RNN}])
    learner = _Learner(objective, parameters, Path(folder))
    if start == "middle":
        learner.to_middle()
    best = learner.evaluated(extra)
    found, curve, used = [default, best.evaluation][: 1 + extra], [], extra
    elements = run_elements(objective.fleet, learner.leaves[0], learner.estimator.surge_limit)
    windows = -(-len(elements.samples.surge) // window)
    optimizer = torch.optim.Adam(learner.groups, betas=BETAS, eps=1e-12)
    rates, current, steps = [group["lr"] for group in optimizer.param_groups], best, 0
    for _ in range(epochs):
        unit = max(min(default.mae, best.evaluation.mae), 1e-6)
        for loss, share in window_losses(
            learner.estimator, elements, current.starts, len(objective.fleet.boats), window
        ):
            objective.advance(EPOCH_COST / windows)
            if not share:
                continue
            curve.append({"loss": float(loss.detach()) / share, **learner.setting()})
            if not learner.set_gradients(loss, CLIP * share * unit):  # it diverges: the rest teaches nothing
                learner.put(best.values)
                break
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * max(0.0, 1 - steps / (epochs * windows))
            optimizer.step()
            learner.clamp()
            steps += 1
        current = learner.evaluated(PASS_COST)
        found.append(current.evaluation)
        used += EPOCH_COST + PASS_COST
        best = min(best, current, key=lambda each: each.evaluation.mae)
    return Fitted(found, used, curve)


class _Evaluated(NamedTuple):
    """The result of a pass through all runs in order."""

    evaluation: Evaluation
    starts: list[Any]  # the state at the start of each run
    values: list[Tensor]  # of the learned parameters


def _network(estimator: Estimator, each: Hyperparameter) -> RNN:
    """The network whose initial weights are learned."""
    return cast(RNN, estimator.get_submodule(owner(each.path)))


class _Learner:
    """The estimator, its learned parameters, and their bounds."""

    def __init__(self, objective: Objective, parameters: Sequence[Hyperparameter], folder: Path):
        self.objective, self.folder, self.files = objective, folder, 0
        self.numbers = [each for each in parameters if each.kind is not RNN]
        self.networks = [each for each in parameters if each.kind is RNN]
        estimator = objective.build({})
        files = {}
        for each in self.networks:  # the network's initial weights come from a file, so that all of them can move
            files[pretrained(each.path)] = self._save(each, _network(estimator, each).init().weights._asdict())
        self.estimator = objective.build(files).requires_grad_(False) if files else estimator.requires_grad_(False)
        logs = [next(self.estimator.get_submodule(each.path).parameters()) for each in self.numbers]
        weights = [w for each in self.networks for w in self._weights(each).values()]
        self.leaves = [leaf.requires_grad_() for leaf in (*logs, *weights)]
        self.bounds = [each.span for each in self.numbers]
        self.bounds += [(each.low, each.high) for each in self.networks for _ in WEIGHTS]
        groups = [{"params": logs, "lr": RATE}, {"params": weights, "lr": WEIGHT_RATE}]
        self.groups = [group for group in groups if group["params"]]

    def _weights(self, each: Hyperparameter) -> dict[str, Tensor]:
        network = _network(self.estimator, each)
        return {name: getattr(network, name) for name in WEIGHTS}

    def _save(self, each: Hyperparameter, weights: Mapping[str, Tensor]) -> str:
        """Initial weights as a file that `pretrained` of an RNN reads; its path."""
        content = io.BytesIO()
        arrays: dict[str, Any] = {name: w.detach().cpu().numpy() for name, w in weights.items()}
        np.savez(content, **arrays)
        path = self.folder / f"{each.path}_{self.files:03d}.npz"
        self.files += 1
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content.getvalue())
        return str(path)

    def setting(self) -> dict[str, float]:
        """The hyperparameters as readable values."""
        return {
            each.path: each.from_scale(float(leaf.detach()))
            for each, leaf in zip(self.numbers, self.leaves, strict=False)
        }

    def to_middle(self) -> None:
        """Each number to the middle of its range; weights stay."""
        self.put([torch.full_like(leaf, sum(each.span) / 2)
                  for each, leaf in zip(self.numbers, self.leaves, strict=False)])  # fmt: skip

    @torch.no_grad()
    def put(self, values: Sequence[Tensor]) -> None:
        for leaf, value in zip(self.leaves, values, strict=False):
            leaf.copy_(value)

    @torch.no_grad()
    def clamp(self) -> None:
        for leaf, (low, high) in zip(self.leaves, self.bounds, strict=True):
            leaf.clamp_(low, high)

    def set_gradients(self, loss: Tensor, longest: float) -> bool:
        """Set the clipped gradient of a loss; returns whether it is finite."""
        gradients = torch.autograd.grad(loss, self.leaves, allow_unused=True)
        for leaf, gradient in zip(self.leaves, gradients, strict=True):
            leaf.grad = torch.zeros_like(leaf) if gradient is None else gradient
        norm = torch.nn.utils.clip_grad_norm_(self.leaves, longest)
        return bool(norm.isfinite() & loss.isfinite())

    def evaluated(self, cost: int) -> _Evaluated:
        """A pass through all runs in order with the present parameters, rounded as they are saved."""
        setting: dict[str, Any] = self.setting()
        self.put([torch.full_like(leaf, each.to_scale(setting[each.path]))
                  for each, leaf in zip(self.numbers, self.leaves, strict=False)])  # fmt: skip
        starts: list[Any] = []
        advance = self.objective.advance
        fleet = self.objective.fleet
        maes = element_errors(self.estimator, fleet, (), lambda share: advance(cost * share), starts.append).mae
        for each in self.networks:
            setting[pretrained(each.path)] = self._save(each, self._weights(each))
        return _Evaluated(
            Evaluation(setting, tuple(maes.tolist())), starts, [leaf.detach().clone() for leaf in self.leaves]
        )


def owner(path: str) -> str:
    """The path of the object that has a hyperparameter.

    >>> owner("estimator.initial"), owner("initial")
    ('estimator', '')
    """
    return path.rpartition(".")[0]


def pretrained(path: str) -> str:
    """The key of the file from which the weights named by `path` are read."""
    return ".".join(filter(None, (owner(path), "pretrained")))
