"""The motion of the joint EKF over a step, (3) of `state`, with its gradient, in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.core.samples import Inputs
from usvlearn.estimators.joint.state import KAPPA, THETA, E
from usvlearn.estimators.regressors.layer import phi1


def flow(mean: Tensor, w: Tensor, b: Tensor, before: Tensor, inputs: Inputs, even: bool) -> tuple[Tensor, Tensor]:
    """w⁺ of (3), `(*batch,)`, and its gradient g to x, `(*batch, n)`.

    Args:
        mean: x, `(*batch, n)`.
        w, b: speed through the water, m/s, and disturbance, m/s², from which it departs.
        before: commands of the step before, `(*batch, 2)`.
        inputs: of the step.
        even: whether the model has the even terms.
    """
    h, turn, speed, sign = inputs.dt, inputs.yaw_rate.abs(), w.abs(), torch.where(w >= 0, 1.0, -1.0)
    u = torch.stack([inputs.command_left, inputs.command_right], -1)
    xi = (1 - mean[..., -1:]) * u + mean[..., -1:] * before
    size, side = xi.abs(), torch.where(xi >= 0, 1.0, -1.0)
    zero = torch.zeros_like(w)
    alpha, beta, gamma = (mean[..., THETA + 3 + k : THETA + 9 : 3] for k in range(3))
    cubic, (wide, broad) = mean[..., KAPPA:E], (x[..., None] for x in (w, speed))
    W_, J_ = [speed * w, w, turn * w], [2 * speed, torch.ones_like(w), turn]  # of f and J to the parameters
    both = zip(xi.unbind(-1), size.unbind(-1), strict=True)
    for x, s in both:
        W_ += [x, x * s, x * speed]
        J_ += [zero, zero, x * sign]
    W_ += (xi**3).unbind(-1)
    J_ += [zero, zero]
    slope, bend = alpha + 2 * beta * size + gamma * broad + 3 * cubic * xi * xi, gamma * sign[..., None]
    curve = mean[..., THETA] * sign
    if even:
        e1, e2, e3 = (mean[..., E + 1 + k : E + 7 : 3] for k in range(3))
        W_.append(w * w)
        J_.append(2 * w)
        for x, s in zip(xi.unbind(-1), size.unbind(-1), strict=True):
            W_ += [s, x * x, x * w]
            J_ += [zero, zero, x]
        slope, bend = slope + e1 * side + 2 * e2 * xi + e3 * wide, bend + e3
        curve = curve + mean[..., E]
    by_parameter, by_speed = torch.stack(W_, -1), torch.stack(J_, -1)
    parameters = mean[..., THETA:-1]
    f, J = (by_parameter * parameters).sum(-1) + b, (by_speed * parameters).sum(-1)
    z = (h * J).clamp(max=1)
    value, derivative = phi1(z)
    by_f, by_J = h * value, h * h * derivative * f
    late, later = ((before - u) * slope).sum(-1), ((before - u) * bend).sum(-1)
    own = [1 + z * value + by_J * 2 * curve, by_f, zero, zero]
    others = by_f[..., None] * by_parameter + by_J[..., None] * by_speed
    g = torch.cat([torch.stack(own, -1), others, (by_f * late + by_J * later)[..., None]], -1)
    return w + by_f * f, g
