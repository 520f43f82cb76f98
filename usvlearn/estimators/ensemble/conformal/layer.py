"""Prediction intervals in torch: equation (1) of `state`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.core.samples import Inputs, tree_map, where
from usvlearn.estimators.ensemble.conformal.state import BOOST, FEW, LEAST, NONE, RATE, START, ConformalState
from usvlearn.estimators.ensemble.manoeuvre_intervals import layer as conditional
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import PATH, StepState


def conformal_start(batch: Sequence[int], k: int, like: Tensor, knows: bool = False) -> ConformalState:
    """The intervals before the first innovation, of k predictions; `knows` whether they know the manoeuvre."""
    own = StepState(conditional.init(batch, k, like), like.new_zeros((*batch, PATH))) if knows else NONE
    return ConformalState(like.new_full((*batch, k), START), like.new_zeros((*batch, k)), own)


def published(state: ConformalState) -> Tensor:
    """The half-widths that do not know the manoeuvre, m/s, `(*batch, k)`: infinite before FEW innovations."""
    return torch.where(state.count < FEW, torch.inf, state.halfwidth)


class Step(NamedTuple):
    """Intervals of the predictions of a step."""

    state: ConformalState  # which has seen the commands of the step
    halfwidths: Tensor  # (*batch, k) m/s, as published
    spread: Tensor  # (*batch, k) m/s, of the members about each prediction
    active: Tensor  # (*batch, k) whether a prediction is a speed


def intervals_of(state: ConformalState, predictions: Tensor, members: int, surge_max: float, inputs: Inputs) -> Step:
    """The intervals of predictions, m/s, `(*batch, k)`, of which the first `members` are the members'."""
    width, active = published(state), predictions.abs() < surge_max
    if not state.conditional:
        return Step(state, width, width, active)
    safe = torch.where(active, predictions.detach(), 0.0)
    some = active[..., None, :members]
    squares = torch.where(some, (safe[..., None, :members] - safe[..., None]) ** 2, 0.0).sum(-1)
    spread = (squares / some.sum(-1).clamp(min=1)).sqrt()
    own: StepState = state.conditional
    path = conditional.extend_path(own.path, inputs.command_left, inputs.command_right)
    far, group = (x(path)[..., None] for x in (conditional.far_of, conditional.group_of))
    held = conditional.hold(own.learned, state.count)
    knows = conditional.halfwidth_held(held, width, spread, far, group)
    return Step(state._replace(conditional=own._replace(path=path)), torch.where(active, knows, width), spread, active)


def intervals_after(step: Step, innovation: Tensor, coverage: float, inputs: Inputs) -> ConformalState:
    """What is known after the innovations of a step, m/s, `(*batch, k)`."""
    state, after = step.state, conformal_step(step.state, innovation, coverage)
    if not state.conditional:
        return after
    own: StepState = state.conditional
    known = innovation.isfinite() & step.active
    e = torch.where(known, innovation, 0.0).abs()
    far, group = (x(own.path)[..., None].expand_as(e) for x in (conditional.far_of, conditional.group_of))
    new = conditional.learn_error(
        own.learned, after.count, e, state.halfwidth, step.spread, far, group, 0.0, 1 - coverage
    )
    learned = tree_map(lambda a, b: where(known, a, b), new, own.learned)
    path = conditional.begin_path(inputs.command_left, inputs.command_right)
    return after._replace(conditional=StepState(learned, path))


def conformal_numbers(coverage: float) -> dict[str, float]:
    """The numbers of `conformal_step`, for its kernel."""
    return {"coverage": coverage, "rate": RATE, "boost": BOOST, "least": LEAST}


def conformal_step(state: ConformalState, innovation: Tensor, coverage: float) -> ConformalState:
    """The intervals after innovations, m/s, `(*batch, k)`: equation (1). A column that is not finite stays."""
    known = innovation.isfinite()
    count = state.count + known
    miss = (innovation.abs() > state.halfwidth).to(state.halfwidth.dtype)
    rate = RATE + BOOST / count.clamp(min=1)
    halfwidth = (state.halfwidth * (rate * (miss - (1 - coverage))).exp()).clamp(min=LEAST)
    return state._replace(halfwidth=torch.where(known, halfwidth, state.halfwidth), count=count)
