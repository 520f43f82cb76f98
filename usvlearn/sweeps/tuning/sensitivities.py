"""Hyperparameters by the exact gradient: sensitivities carried along all runs (`docs/theory/ensemble.md#tuning`).

With the state s_k, the step s_{k+1} = f(s_k, z_k, x) and hyperparameters x on their scale (logarithm or logit), the
sensitivity S_k = ds_k/dx is carried along the run with the state (Williams & Zipser 1989):

    S_{k+1} = ∂f/∂s S_k + ∂f/∂x,   dL/dx = Σ_k w_k sgn(v̂_k − v_k) dv̂_k/dx                (1)

The memory does not grow with the run, and the effect of a gain many minutes later is included. Truncated
back-propagation omits that effect, and is biased where the memory is long.

Dual numbers carry the sensitivity: each of the p hyperparameters is an element of one batch, with tangent 1 in its own
batch element. A pass gives the error and its gradient. Its arithmetic is that of `COST` evaluations for each
hyperparameter, because a product needs two more products for its tangent. With few boats the time goes into the calls
of operations, not into arithmetic; a pass then takes the time of four to seven single replays.

The descent is a damped quasi-Newton method (BFGS; Nocedal & Wright 2006, procedure 18.2) inside the ranges, with a
bound on the step. The first step has the same length along each scale, whatever the size of the gradient, because the
effects of hyperparameters differ by orders of magnitude. A step is accepted only if the error falls.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.forward_ad import dual_level, make_dual, unpack_dual
from torch.overrides import TorchFunctionMode

from usvlearn.core.protocol import Estimator
from usvlearn.errors import ConfigError, check_choice
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, Setting, element_errors

STARTS = ("default", "middle")
COST = 3  # evaluations for each hyperparameter and pass
FIRST = 1.0  # length of the first step, along each scale
GROW, SHRINK = 2.0, 0.5  # factors of the bound: after a step that reached it; after a failed step, of its length
FLAT = 0.01  # share of the largest slope; smaller slopes are raised to it in the first step
CURVATURE = 0.2  # least share of the expected curvature that an update may keep (the damping)
LEAST = 1e-7  # share of the error; no step is made whose expected gain is smaller

MIXING = {"minimum", "maximum", "linalg_solve_ex", "__radd__", "__rsub__", "__rmul__", "__rdiv__", "__rtruediv__"}
MIXING |= {name for each in ("add", "sub", "mul", "div", "truediv") for name in (each, f"__{each}__")} | {"rsub"}


class Fitted(NamedTuple):
    """The result of tuning."""

    evaluations: list[Evaluation]  # the default first
    used: int  # evaluations used, without the default
    curve: list[dict[str, float]]  # of the gradient, per pass: the MAE, m/s, and the hyperparameters


class _FleetMae(nn.Module):
    """The MAE of `element_errors` as a module's forward, so that dual numbers can replace its parameters."""

    def __init__(self, estimator: Estimator):
        super().__init__()
        self.estimator = estimator

    def forward(self, *arguments) -> Tensor:
        return element_errors(self.estimator, *arguments).mae


class _AllDual(TorchFunctionMode):
    """Turns constants that meet dual numbers into dual numbers; mixed, torch takes a hundred times as long."""

    def __init__(self):
        super().__init__()
        self.constants: dict[float, Tensor] = {}

    def __torch_function__(self, function, types, arguments=(), named=None):
        if getattr(function, "__name__", "") in MIXING and len(arguments) > 1:
            dual = next((x for x in arguments if is_dual(x)), None)
            if dual is not None:
                arguments = [self._lifted(x, dual) for x in arguments]
        return function(*arguments, **(named or {}))

    def _lifted(self, x: Any, like: Tensor) -> Tensor:
        if is_dual(x):
            return x
        if isinstance(x, Tensor):
            x = x.to(like).contiguous()
            return make_dual(x, torch.zeros_like(x))
        if x not in self.constants:
            self.constants[x] = make_dual(like.new_tensor(x), like.new_zeros(()))
        return self.constants[x]


def is_dual(x: Any) -> bool:
    """Whether a value carries a tangent.

    >>> is_dual(torch.ones(2))
    False
    """
    return isinstance(x, Tensor) and x.is_floating_point() and unpack_dual(x).tangent is not None


def sensitivity(
    objective: Objective, parameters: Sequence[Hyperparameter], setting: Setting
) -> tuple[Evaluation, Tensor]:
    """The evaluation of a setting, and the gradient of its MAE with respect to each scaled hyperparameter, m/s, `(p,)`.

    Raises:
        ConfigError: an operation of the estimator has no forward derivative.
    """
    p = len(parameters)
    module = _FleetMae(objective.build({path: [[value]] * p for path, value in setting.items()}))
    leaves = dict(module.named_parameters())
    with torch.no_grad(), dual_level():
        with warnings.catch_warnings():  # from torch, when it loads its derivatives
            warnings.filterwarnings("ignore", ".*torch.jit.script", DeprecationWarning)
            duals = {}
            for each, own in zip(parameters, torch.eye(p), strict=True):
                name = next(name for name in leaves if name.startswith(f"estimator.{each.path}."))
                duals[name] = make_dual(leaves[name], own[:, None].to(leaves[name]))
        arguments = objective.fleet, (p,), lambda share: objective.advance(COST * p * share)
        try:
            with _AllDual():
                maes = torch.func.functional_call(module, duals, arguments)
        except NotImplementedError as error:
            raise ConfigError(
                f"learn: this estimator has no forward derivative ({str(error).partition('.')[0]}): use grid or search"
            ) from error
        maes, gradient = unpack_dual(maes)
        gradient = torch.zeros_like(maes) if gradient is None else gradient
    return Evaluation(setting, tuple(maes[0].tolist())), gradient.mean(-1).cpu()


def descend(
    objective: Objective, parameters: Sequence[Hyperparameter], evaluations: int, start: str = "default"
) -> Fitted:
    """Learn hyperparameters by the exact gradient, starting from the default, or from the middle of the ranges.

    It ends within the budget, or earlier if no further step is expected to help.

    Args:
        objective: evaluates settings, and makes the estimator.
        parameters: the learned hyperparameters.
        evaluations: the budget.
        start: "default" or "middle".

    Returns:
        The evaluations, the default first, then those of the passes; the curve has a point for each pass.

    Raises:
        ConfigError: fewer evaluations than two passes cost, or an unknown start.
    """
    check_choice("tuning.start", start, STARTS)
    cost = COST * len(parameters)
    if evaluations < 2 * cost:
        raise ConfigError(f"tuning.evaluations: found {evaluations}, expected {2 * cost} or more, the cost of learn")
    low, high = torch.tensor([each.span for each in parameters], dtype=torch.float64).T
    default = {each.path: each.default for each in parameters}
    found: list[Evaluation] = []
    curve: list[dict[str, float]] = []

    def evaluated(place: Tensor) -> tuple[Tensor, float, Tensor]:
        """The evaluated place, rounded as it is saved; the error; the gradient."""
        setting = {each.path: each.from_scale(x) for each, x in zip(parameters, place.tolist(), strict=True)}
        if not found and setting != default:
            found.extend(objective([default]))
        evaluation, gradient = sensitivity(objective, parameters, setting)
        found.append(evaluation)
        if finite := bool(gradient.isfinite().all()):
            curve.append({"loss": evaluation.mae, **setting})
        place = place.new_tensor([each.to_scale(setting[each.path]) for each in parameters])
        return place, evaluation.mae if finite else torch.inf, gradient

    given = [sum(each.span) / 2 if start == "middle" else each.to_scale(each.default) for each in parameters]
    place, error, gradient = evaluated(low.new_tensor(given).clamp(low, high))
    curvature = gradient.abs().clamp(min=FLAT * gradient.abs().max()).diag() / FIRST
    passes, bound = 1, FIRST
    while (passes + 1) * cost <= evaluations and error < torch.inf:
        # A parameter that would leave its range stays at the end of the range.
        free = ~(((place <= low) & (gradient > 0)) | ((place >= high) & (gradient < 0))) & (curvature.diag() > 0)
        step = torch.zeros_like(place)
        step[free] = torch.linalg.solve(curvature[free][:, free], -gradient[free])
        step = step * min(1.0, bound / max(float(step.abs().max()), 1e-300))
        step = (place + step).clamp(low, high) - place
        promise = -float(gradient @ step + step @ curvature @ step / 2)
        if not promise > LEAST * error:
            break
        tried, tried_error, tried_gradient = evaluated(place + step)
        passes += 1
        step = tried - place
        if tried_error < torch.inf and step.any():
            curvature = updated(curvature, step, tried_gradient - gradient)
        longest = float(step.abs().max())
        if tried_error < error:
            place, error, gradient = tried, tried_error, tried_gradient
            bound *= GROW if longest > 0.99 * bound else 1.0
        else:
            bound = SHRINK * longest
    return Fitted(found, passes * cost, curve)


def updated(curvature: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """The damped BFGS update of a second derivative, `(p, p)`; it stays positive where the error is not convex.

    >>> updated(torch.eye(2), torch.tensor([1.0, 0.0]), torch.tensor([3.0, 0.0]))
    tensor([[3., 0.],
            [0., 1.]])
    """
    expected = curvature @ step
    whole, seen = step @ expected, step @ change
    if seen < CURVATURE * whole:
        share = (1 - CURVATURE) * whole / (whole - seen)
        change = share * change + (1 - share) * expected
    return curvature - expected.outer(expected) / whole + change.outer(change) / (step @ change)
