"""The ways that `cuda.py` measures: predictions and gradients of a run by compiled code, torch, and a captured step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call, grad, vmap

from usvlearn import Estimator, Sample, rollout
from usvlearn.core.samples import named_leaves, tree_map

Work = Callable[[], Any]


def rolled(estimator: Estimator, run: Sample, backend: str) -> Work:
    """The predictions of a run, without gradients."""
    state = tree_map(Tensor.detach, estimator.init(run.surge.shape[1:]))

    def work() -> Tensor:
        with torch.no_grad():
            return rollout(estimator, state, run, backend=backend)[1]

    return work


def compiled(estimator: Estimator, run: Sample) -> Work:
    return rolled(estimator, run, "kernel")


def eager(estimator: Estimator, run: Sample) -> Work:
    return rolled(estimator, run, "torch")


def stepped(estimator: Estimator, run: Sample) -> Work:
    """The predictions of a run by `torch.compile` of one step."""
    step, start = torch.compile(estimator.learn), tree_map(Tensor.detach, estimator.init(run.surge.shape[1:]))

    def work() -> Tensor:
        state, found = start, []
        with torch.no_grad():
            for k in range(len(run.surge)):
                state, surge = step(state, tree_map(lambda x, k=k: x[k], run.inputs), run.surge[k])
                found.append(surge)
        return torch.stack(found)

    return work


class Graphed:
    """A run by replays of one captured step, which changes its state, its count and its predictions in place.

    Where there is no CUDA the step is not captured, but made anew each time; tests do so.
    """

    def __init__(self, estimator: Estimator, run: Sample):
        self.estimator, self.run = estimator, run
        self.start = tree_map(Tensor.detach, estimator.init(run.surge.shape[1:]))
        self.state = tree_map(torch.clone, self.start)
        self.step_count = torch.zeros(1, dtype=torch.long, device=run.surge.device)
        self.predictions = torch.zeros_like(run.surge)
        self.replay: Work = self._captured() if run.surge.is_cuda else self._step

    @torch.no_grad()
    def _step(self) -> None:
        now = tree_map(lambda x: x.index_select(0, self.step_count)[0], self.run)
        state, predicted = self.estimator.learn(self.state, now.inputs, now.surge)
        self._write(state)
        self.predictions.index_copy_(0, self.step_count, predicted[None])
        self.step_count += 1

    def _write(self, state: Any) -> None:
        """Overwrite the state; a leaf that lies in the memory of the old one is copied before."""
        old = [leaf for _, leaf in named_leaves(self.state)]
        places = {leaf.untyped_storage().data_ptr() for leaf in old}
        new = [leaf for _, leaf in named_leaves(state)]
        new = [leaf.clone() if leaf.untyped_storage().data_ptr() in places else leaf for leaf in new]
        for into, leaf in zip(old, new, strict=True):
            into.copy_(leaf)

    def _captured(self) -> Work:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):  # libraries are loaded, and memory is found, before the capture
            for _ in range(2):
                self._step()
                self.step_count.zero_()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._step()
        return graph.replay

    def __call__(self) -> Tensor:
        self._write(tree_map(torch.clone, self.start))
        self.step_count.zero_()
        for _ in range(len(self.run.surge)):
            self.replay()
        return self.predictions


def error(estimator: Estimator, run: Sample) -> Tensor:
    """The mean square error of a run, m²/s²."""
    predicted = rollout(estimator, estimator.init(run.surge.shape[1:]), run, backend="torch")[1]
    return (predicted - run.surge).square().mean()


def learnable(estimator: Estimator) -> dict[str, Tensor]:
    return {name: x for name, x in estimator.named_parameters() if x.requires_grad}


def backward(estimator: Estimator, run: Sample) -> Work:
    """The gradient of the error of all batch elements together, by each hyperparameter."""
    leaves = learnable(estimator)

    def work() -> dict[str, Tensor]:
        found = torch.autograd.grad(error(estimator, run), list(leaves.values()), allow_unused=True)
        return {name: x for name, x in zip(leaves, found, strict=True) if x is not None}

    return work


class _Error(torch.nn.Module):
    """`error` as a module, so that `torch.func` can replace its hyperparameters."""

    def __init__(self, estimator: Estimator):
        super().__init__()
        self.estimator = estimator

    def forward(self, run: Sample) -> Tensor:
        return error(self.estimator, run)


def mapped(estimator: Estimator, run: Sample) -> Work:
    """The gradient of the error of each batch element alone, `(elements, …)`."""
    module = _Error(estimator)
    leaves = {name: x.detach() for name, x in learnable(module).items()}
    each = vmap(grad(lambda leaves, one: functional_call(module, leaves, (one,))), (None, 1))
    return lambda: each(leaves, run)
