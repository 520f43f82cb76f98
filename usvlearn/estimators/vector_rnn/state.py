"""A shallow ReLU recurrent network of several components of the velocity, learned online (the paper's for ℝ^q).

With x_i = v_i/v_max,i for surge, sway and yaw rate, and u = [ξ_L, ξ_R], or [ξ_L, ξ_R, sin θ, cos θ]:

    z = W x + W₂ u + b,   x⁺ = R x + A relu(z)                                                            (1)

The last M samples are kept. The loss is that of open-loop simulations over windows of H of them: a window starts at the
velocity from which its first step departed, and each later step departs from the network's own velocity, unless the
samples are not successive. With w_ki = `importance` of component i where it was measured, else 0,

    L = 1/(2 B H) Σ_windows Σ_k Σ_i w_ki (x̂_{k+1,i} − x_meas,k+1,i)²                                       (2)

One of the B windows ends with the newest sample. The others are drawn by the counter of `usvlearn.estimators.rnn.state`
(5), so that no random number is needed. The gradient of a window is written out, backwards from its last step: with
e_k = w_k (x̂_{k+1} − x_meas,k+1)/H, d_k = [z_k > 0], and g_H = 0,

    λ_k = e_k + g_{k+1},   ζ_k = d_k ∘ Aᵀ λ_k,   g_k = Rᵀ λ_k + Wᵀ ζ_k, 0 where the samples are not successive,
    ∂L/∂R = Σ λ_k x_kᵀ,   ∂L/∂A = Σ λ_k relu(z_k)ᵀ,   ∂L/∂(W, W₂, b) = Σ ζ_k (x_k, u_k, 1)ᵀ                 (3)

After every step of Adam the weights are projected onto those that contract at κ
(`certify.training.vector_projections`):

    max_i t_i |x_i − x'_i|   shrinks by κ with every step, for equal inputs and the same sequence of weights,     (4)

where t is `scaling`. The statement holds in the components divided by their maxima, and hence in m/s and rad/s with the
weights t_i/v_max,i. The network starts as persistence, R = κ I and A = 0: it has to learn drag, thrust and coupling.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

COAST_LIMIT = 2.0  # of |x|, from which a step departs
BETA2, EPSILON = 0.999, 1e-8  # Adam's
MOST_NEURONS, MOST_KEPT, MOST_WINDOWS = 1000, 100_000, 1000


class NetworkWeights(NamedTuple):
    """The weights of (1), of components divided by their maxima; `certify.networks.vector` has the same names."""

    R: Tensor  # (*batch, q, q)
    A: Tensor  # (*batch, q, n)
    W: Tensor  # (*batch, n, q)
    W2: Tensor  # (*batch, n, m)
    b: Tensor  # (*batch, n)


class Kept(NamedTuple):
    """The last M samples, in a ring. A new one takes the place of the oldest."""

    before: Tensor  # (*batch, M, q) x from which the step departs
    inputs: Tensor  # (*batch, M, m) u
    target: Tensor  # (*batch, M, q) x that was measured; 0 where none was
    weight: Tensor  # (*batch, M, q) w where it was measured, else 0
    successive: Tensor  # (*batch, M) 1 where the sample one place earlier led to this one, else 0
    learned: Tensor  # (*batch,) count of samples so far, which goes from 2M back to M
    turn: Tensor  # (*batch,) the counter of the windows


class VectorRNNState(NamedTuple):
    """The weights, Adam's mean squared gradient, the velocity, and the samples that are learned again."""

    weights: NetworkWeights
    moment: Tensor  # (*batch, q² + 2qn + nm + n) in the order R, A, W, W2, b
    updates: Tensor  # (*batch,) count of updates
    velocity: Tensor  # (*batch, q) from which the next step departs, m/s, m/s, rad/s
    unbroken: Tensor  # (*batch,) bool: the step to `velocity` was learned from
    kept: Kept
