"""A certificate about a network with a vector state: the claim, and a proof that rational arithmetic alone can check.

    gershgorin, lmi     P and Λ with M(P, Λ) ≻ 0, slopes in [0, 2]: the paper's lemma and its LMI for a vector state
    quadratic           P and Λ with M(P, Λ) ≻ 0, the slopes of φ    (`vector_exact`, 3; of torch.nn.RNN `recurrent`, 2)
    exact               a norm and a scaling T, in which all activation patterns contract (`vector_exact`, 2)

`exact` names a step η, by default 1. With another one the claim is about f_η(x) = x + η (f(x, u) − x), which is f at η
times its step, and it holds for all smaller steps, too (`certify.proofs.steps`).
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from certify.errors import CertifyError, shortened
from certify.networks.vector import (
    MOST_STATES,
    Activation,
    VectorNetwork,
    VectorWeights,
    check,
    digest,
    is_recurrent,
)
from certify.proofs import vector_exact
from certify.proofs.certificate import (
    DIGITS,
    KEYS,
    Verification,
    described,
    fraction,
    frame_refusal,
    provable_rate,
    signed,
)
from certify.proofs.exact import lemma_is_long
from certify.proofs.rational import Matrix, diagonal, identity
from certify.proofs.rounding import above, below, float_below
from certify.proofs.steps import stepped
from certify.proofs.vector_exact import NORMS, Proof

FORMAT = "usvlearn vector certificate 1"
CONDITIONS = ("gershgorin", "lmi", "quadratic", "exact")
BY_MATRIX = CONDITIONS[:3]
OWN_KEYS = KEYS | {"states", "activation"}
LONGEST_NUMBER = 120  # characters of an entry of P or Λ, or of a step
LONGEST_SCALING = 40  # of an entry of T: the exact rate multiplies it with every weight
LONGEST_CHECK = "about 5 s"  # `vector_exact.WORK`, in words
SMALLEST_RATE = Fraction(1, 1000)  # that is claimed; a solver cannot tell a smaller one from zero


def make(
    network: VectorNetwork,
    condition: str,
    rate: Fraction | float | None = None,
    proof: Proof | None = None,
    norm: str = "inf",
    scaling: Matrix | None = None,
    step: Fraction | None = None,
) -> dict[str, Any] | None:
    """A certificate, ready for JSON.

    Args:
        network: one network.
        condition: one of `CONDITIONS`.
        rate: κ at which it is to hold, no unit, at most 1. By default, of `gershgorin` and `exact`, a short decimal
            just above the smallest one; otherwise 1.
        proof: P and Λ, of `lmi` and `quadratic` from `certify.search`; of `gershgorin` they are computed here.
        norm: "inf" or "one", of `exact`.
        scaling: T of it, `(q, q)`; the identity by default.
        step: η of `exact`, a number of steps of the network; 1 by default.

    Returns:
        The certificate; None where the condition does not hold, or the proof does not prove it.

    Raises:
        CertifyError: weights that are no network, an unknown condition, or a rate that is not in (0, 1].

    >>> import numpy as np
    >>> from certify.networks.vector import RELU
    >>> net = VectorNetwork("", check(VectorWeights(None, [[0.5]], [[1.0]], np.zeros((1, 0)), [0.0])), RELU)
    >>> proved = make(net, "exact")
    >>> proved["rate"], verify(proved, net).valid
    ('500001/1000000', True)
    """
    weights = check(network.weights, network.path or "weights")
    if condition not in CONDITIONS:
        raise CertifyError(f"condition: found {condition!r}, expected one of {', '.join(CONDITIONS)}")
    if rate is not None and not 0 < rate <= 1:
        raise CertifyError(f"rate: found {rate}, expected a number above 0 and at most 1")
    smallest: Fraction | None = Fraction(1)
    if condition == "gershgorin":
        smallest = (
            vector_exact.gershgorin(weights)[1] if weights.V is None and network.activation.name == "relu" else None
        )
    elif condition == "exact":
        smallest = _exact_rate(weights, network.activation, norm, scaling, step)
    kappa = (Fraction(1) if smallest == 1 else _provable(smallest)) if rate is None else Fraction(rate)
    if kappa is None:
        return None
    if condition == "gershgorin":
        proof = vector_exact.gershgorin_proof(weights, kappa)
    if condition in BY_MATRIX:
        if proof is None:
            return None
        parts: dict[str, Any] = {
            "metric": [[str(x) for x in row] for row in proof.metric],
            "multipliers": [[str(x) for x in each] for each in proof.multipliers],
        }
    else:
        matrix = identity(len(weights.R)) if scaling is None else scaling
        scaled = [[str(x) for x in row] for row in matrix]
        parts = {"norm": norm, "scaling": scaled, "step": str(Fraction(1) if step is None else step)}
    if not _short(parts):
        return None
    content = described(_claims(weights, network.activation, condition, kappa, parts), parts, network.path)
    return content if verify(content, network).valid else None


def _provable(rate: Fraction | None) -> Fraction | None:
    return None if rate is None else provable_rate(max(rate, SMALLEST_RATE))


def _exact_rate(
    weights: VectorWeights, phi: Activation, norm: str, scaling: Matrix | None, step: Fraction | None
) -> Fraction:
    taken = weights if step is None else stepped(weights, step)
    return vector_exact.rate(taken, vector_exact.everywhere(weights, phi), norm, scaling)


def verify(certificate: Mapping[str, Any], network: VectorNetwork) -> Verification:
    """Check a certificate against a network: its keys, its checksum, the weights, every claim, and the proof.

    A certificate may come from anybody. The time to check it is bounded by its length and by the size of the network.
    The activation that it names must be that of the network.

    Args:
        certificate: such as `certify.proofs.certificate.read` returns.
        network: one network.

    Returns:
        Whether it is valid; and the claim that is proved, or the reason why it is not.

    >>> verify({"format": FORMAT}, VectorNetwork("", VectorWeights(None, [[0.5]], [[1.0]], [[0.0]], [0.0]))).valid
    False
    """
    try:
        reason = _refusal(dict(certificate), network._replace(weights=check(network.weights)))
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
        reason = f"it cannot be read as a certificate: {type(error).__name__} {shortened(error)}"
    return Verification(False, reason) if reason else Verification(True, certificate["claim"])


def _refusal(content: dict[str, Any], network: VectorNetwork) -> str | None:
    """Why a certificate is refused; None where it is valid."""
    weights, phi = network.weights, network.activation
    condition: Any = content.get("condition")
    if condition == "box":
        return "it is about a box of a vector state, which is proved no more: make it again, by exact or quadratic"
    expected = {"metric", "multipliers"} if condition in BY_MATRIX else {"norm", "scaling", "step"}
    if reason := frame_refusal(content, FORMAT, OWN_KEYS, CONDITIONS, expected, digest(weights)):
        return reason
    if content["activation"] != str(phi):
        return f"it is about the activation {shortened(content['activation'])}, and the network has {phi}"
    kappa, proof = fraction(content["rate"]), content["proof"]
    if not 0 < kappa <= 1:
        return f"its rate is {shortened(kappa)}, expected one above 0 and at most 1"
    if reason := signed(content, _claims(weights, phi, condition, kappa, proof)):
        return reason
    if condition in BY_MATRIX:
        stated = Proof(_matrix(proof["metric"]), _matrix(proof["multipliers"]))
        if condition != "quadratic" and (phi.name != "relu" or (condition == "gershgorin" and weights.V is not None)):
            return f"its condition {condition} is about another kind of network"
        long = condition != "quadratic" and len(weights.R) > MOST_STATES
        long = long or (condition == "gershgorin" and lemma_is_long(weights.W))
        if long or vector_exact.effort(weights) > vector_exact.WORK:
            return f"the network is too large: the check would take longer than {LONGEST_CHECK}"
        most = phi.most if condition == "quadratic" else Fraction(2)
        if not vector_exact.proves(weights, phi, stated, kappa, most):
            return "its P and Λ do not make M positive definite, or take too long to check"
        if condition == "gershgorin" and not _below(vector_exact.gershgorin(weights)[1], kappa):
            return "the lemma's inequalities do not hold at its rate"
        return None
    scaling = _matrix(proof["scaling"], LONGEST_SCALING)
    q = len(weights.R)
    if proof["norm"] not in NORMS or len(scaling) != q or any(len(row) != q for row in scaling):
        return "its norm or its T is of another kind"
    step = _number(proof["step"])
    many = q > MOST_STATES and (step != 1 or diagonal(scaling) is None)  # else T needs no signs and no inverse
    if many or vector_exact.effort(weights, scaling, proof["norm"]) > vector_exact.WORK:
        return f"its T is too long, or the network too large: the check would take longer than {LONGEST_CHECK}"
    if not step > 0 or not _below(_exact_rate(weights, phi, proof["norm"], scaling, step), kappa):
        return "the exact rate in its norm is not below its rate"
    return None


def _below(rate: Fraction | None, kappa: Fraction) -> bool:
    return rate is not None and rate < kappa


def _claims(
    weights: VectorWeights, phi: Activation, condition: str, kappa: Fraction, proof: Mapping[str, Any]
) -> dict[str, Any]:
    """The claims of a certificate, derived from the weights, the condition, the rate and the parts of the proof."""
    n, m = weights.W2.shape
    # slopes in [0, 2] at κ: where J is linear in the slopes of each layer, in [0, 1] at κ/2, with two layers at κ/4
    twice = condition in ("gershgorin", "lmi") and not weights.R.any()
    bound = kappa / (4 if weights.V is not None else 2) if twice else kappa
    where, how, what = "for all x₁, x₂ and u", "", "f(x₁, u) − f(x₂, u)"
    if condition in BY_MATRIX:
        norm, how = "|{}|_P", "M(P, Λ) is positive definite: LDLᵀ in rational arithmetic"
        if condition == "quadratic" and is_recurrent(weights):
            how = "M(P, Λ) is positive definite: a congruence that is diagonally dominant, in integers"
    else:
        norm = "‖T ({})‖" + ("_∞" if proof["norm"] == "inf" else "₁")
        how = "the largest norm over all activation patterns, in rational arithmetic"
    right = above(bound, DIGITS + 1)
    if condition == "exact" and (step := _number(proof["step"])) != 1:
        what = "f_η(x₁, u) − f_η(x₂, u)"
        right = f"(1 − {below((1 - bound) / step, DIGITS)} η)"
        where = f"for all x₁, x₂, u and 0 < η ≤ {step}, f_η(x, u) = x + η (f(x, u) − x)"
    if phi.name != "relu":
        where += f", φ = {phi}"
    relation = "<" if bound == 1 else "≤"
    return {
        "format": FORMAT,
        "claim": f"{norm.format(what)} {relation} {right} {norm.format('x₁ − x₂')} {where}",
        "weights": digest(weights),
        "states": len(weights.R),
        "neurons": n + (0 if weights.c is None else len(weights.c)),
        "inputs": m,
        "activation": str(phi),
        "condition": condition,
        "rate": str(kappa),
        "margin": float_below(1 - kappa),
        "contraction_rate": str(bound),
        "verified": how,
    }


def _short(parts: Mapping[str, Any]) -> bool:
    """Whether the numbers of a proof are as short as verification expects."""
    limits = {"metric": LONGEST_NUMBER, "multipliers": LONGEST_NUMBER, "scaling": LONGEST_SCALING}
    rows = [(row, most) for key, most in limits.items() for row in parts.get(key, [])]
    return len(parts.get("step", "")) <= LONGEST_NUMBER and all(len(x) <= most for row, most in rows for x in row)


def _matrix(rows: Any, longest: int = LONGEST_NUMBER) -> Matrix:
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise TypeError("a matrix is no list of lists")
    return [[_number(x, longest) for x in row] for row in rows]


def _number(text: Any, longest: int = LONGEST_NUMBER) -> Fraction:
    if isinstance(text, str) and len(text) > longest:
        raise ValueError(f"a number has more than {longest} characters")
    return fraction(text)
