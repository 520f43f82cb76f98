"""A certificate: a claim about one network, and a proof that anyone can check with rational arithmetic alone.

    simple, gershgorin, lmi, exact     a metric p and multipliers Λ with M(p, Λ) ≻ 0        (`exact`)
    interval, box                      a tree of boxes, on each of which the slope is bounded (`box_proof`)

`verify` needs neither a solver nor torch. It rebuilds every statement from the weights. The checksum only detects
accidental changes; the mathematics detects all others.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from decimal import Decimal
from fractions import Fraction
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError, quoted, shortened
from certify.networks.shallow import ShallowWeights, check, digest
from certify.proofs import box_planes, box_proof, exact
from certify.proofs.box_planes import Box
from certify.proofs.rounding import above, float_below

FORMAT = "usvlearn certificate 2"
CLOSED_FORMS = tuple(exact.CORNER)
CONDITIONS = (*CLOSED_FORMS, "interval", "box")  # from the narrowest to the widest
DIGITS = 6  # of the rate that is proved, rounded up
LONGEST = 100_000  # characters of p and Λ together, which take about 2 s
MOST_ROWS = 5_000  # of M, whose entries are all looked at once
LARGEST = 10_000_000  # bytes of a file
LONGEST_PART = 1500  # digits of a numerator or a denominator
FRACTION = re.compile(rf"-?[0-9]{{1,{LONGEST_PART}}}(/[0-9]{{1,{LONGEST_PART}}})?")
KEYS: set[str] = set("format claim weights neurons inputs condition rate margin contraction_rate verified".split())
KEYS |= set("proof path versions sha256".split())


class Verification(NamedTuple):
    """The result of checking a certificate."""

    valid: bool
    reason: str  # what was proved, or why it is refused


def provable_rate(rate: Fraction | float) -> Fraction | None:
    """A short decimal above a rate and below 1; None where there is none."""
    rate, scale = Fraction(rate), 10**DIGITS
    if rate >= 1:
        return None
    while (above := Fraction(rate * scale // 1 + 1, scale)) >= 1:
        scale *= 10
    return above


def make(
    weights: ShallowWeights,
    condition: str = "exact",
    rate: Fraction | float | None = None,
    box: Box | None = None,
    tree: str = ".",
    invariance_tree: str | None = None,
    path: str = "",
) -> dict[str, Any] | None:
    """A certificate, ready for JSON.

    Args:
        weights: of one network.
        condition: `simple`, `gershgorin`, `lmi`, `exact`; or `interval`, `box`, with a box.
        rate: κ at which it is to hold, no unit, at most 1; by default a short decimal just above the smallest.
        box: of `interval` and `box`.
        tree: of `box`, from `certify.search.box.certify`.
        invariance_tree: likewise, where f maps the box into its interval of x.
        path: of the file that holds the weights.

    Returns:
        The certificate; None where the condition does not hold, or the tree does not prove it.

    Raises:
        CertifyError: weights that are no network, an unknown condition, a rate that is not in (0, 1], or no box.

    >>> proved = make(ShallowWeights([0.5], [1.0], [[0.0]], [0.0]))
    >>> proved["condition"], proved["rate"], verify(proved, ShallowWeights([0.5], [1.0], [[0.0]], [0.0])).valid
    ('exact', '500001/1000000', True)
    """
    weights = check(weights, path or "weights")
    if rate is not None and not 0 < rate <= 1:
        raise CertifyError(f"rate: found {rate}, expected a number above 0 and at most 1")
    if condition in CLOSED_FORMS:
        least = exact.condition(condition, weights.a, weights.w1).rate
        kappa = provable_rate(least) if rate is None and least is not None else rate
        proof = None if least is None or kappa is None else exact.multipliers(condition, weights.a, weights.w1, kappa)
        if proof is None or kappa is None:
            return None
        parts: dict[str, Any] = {"metric": str(proof.metric), "multipliers": [str(x) for x in proof.multipliers]}
    elif condition in ("interval", "box"):
        if box is None:
            raise CertifyError(f"{condition}: found no box, expected the box on which the condition is to hold")
        if condition == "interval":
            tree = "."
            rate = provable_rate(box_planes.interval_rate(weights, box)) if rate is None else rate
            if rate is None:
                return None
        kappa = 1 if rate is None else rate
        parts = {"box": pairs(box), "tree": tree, "invariance_tree": invariance_tree}
    else:
        raise CertifyError(f"condition: found {condition!r}, expected one of {', '.join(CONDITIONS)}")
    content = described(_claims(weights, condition, Fraction(kappa), parts), parts, path)
    return content if verify(content, weights).valid else None


def verify(certificate: Mapping[str, Any], weights: ShallowWeights) -> Verification:
    """Check a certificate against weights: its keys, its checksum, the weights it names, every claim, and the proof.

    A certificate may come from anybody. The time to check it is bounded by its length, whatever it contains.

    Args:
        certificate: such as `read` returns.
        weights: of one network.

    Returns:
        Whether it is valid; and the claim that is proved, or the reason why it is not.

    >>> proved = make(ShallowWeights([0.5], [1.0], [[0.0]], [0.0]))
    >>> verify(proved, ShallowWeights([0.75], [1.0], [[0.0]], [0.0])).reason
    'it is about other weights: their sha256 differs'
    """
    try:
        reason = _refusal(dict(certificate), check(weights))
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
        reason = f"it cannot be read as a certificate: {type(error).__name__} {shortened(error)}"
    return Verification(False, reason) if reason else Verification(True, certificate["claim"])


def _refusal(content: dict[str, Any], weights: ShallowWeights) -> str | None:
    """Why a certificate is refused; None where it is valid."""
    closed = content.get("condition") in CLOSED_FORMS
    expected = {"metric", "multipliers"} if closed else {"box", "tree", "invariance_tree"}
    if reason := frame_refusal(content, FORMAT, KEYS, CONDITIONS, expected, digest(weights)):
        return reason
    condition, proof = content["condition"], content["proof"]
    kappa = fraction(content["rate"])
    if not 0 < kappa <= 1:
        return f"its rate is {shortened(kappa)}, expected one above 0 and at most 1"
    if closed and len(weights.a) + 2 > MOST_ROWS:
        return f"its M has more than {MOST_ROWS} rows: the check would take longer than about 5 s"
    if condition == "gershgorin" and exact.lemma_is_long(weights.w1):
        return "its weights have too many digits for the lemma's sum: the check would take longer than about 5 s"
    if reason := signed(content, _claims(weights, condition, kappa, proof)):
        return reason
    if closed:
        texts = [proof["metric"], *proof["multipliers"]]
        if not isinstance(proof["multipliers"], list) or sum(map(len, texts)) > LONGEST:
            return f"its Λ is no list, or longer than {LONGEST} characters"
        metric, *multipliers = map(fraction, texts)
        if not exact.proves(condition, weights.a, weights.w1, exact.Multipliers(metric, multipliers), kappa):
            return "its p and Λ do not make M positive definite"
        return None
    box, tree, invariance_tree = box_of(proof["box"]), proof["tree"], proof["invariance_tree"]
    if len(box.lo) != 1 + weights.W2.shape[-1] or (condition == "interval" and tree != "."):
        return "its box or its tree is of another kind than its condition"
    if isinstance(tree, str) and re.search(r"(^|\s)[zesd]", tree):
        return "its tree has cells of neurons or linear programs, by which nothing is proved any more: make it again"
    if not box_proof.proves(weights, box, tree, kappa):
        return "its tree does not bound the slope on the box, or is too long to replay"
    if invariance_tree is not None and not box_proof.proves_range(weights, box, invariance_tree):
        return "its tree does not keep x inside the box, or is too long to replay"
    return None


def frame_refusal(
    content: dict[str, Any],
    form: str,
    keys: Set[str],
    conditions: Sequence[str],
    parts: set[str],
    weights: str,
) -> str | None:
    """Why the frame of a certificate is refused: its format, condition, keys, checksum or weights; None where it fits.

    `parts` are the keys of its proof, `weights` is the digest of the network's.
    """
    if content.get("format") != form:
        return f"it has the format {quoted(content.get('format'))}, expected {form!r}: make it again"
    condition: Any = content.get("condition")
    proof: Any = content.get("proof")
    if condition not in conditions:
        return f"it names the condition {quoted(condition)}, expected one of {', '.join(conditions)}: make it again"
    for word, wrong in (
        ("has unknown", (content.keys() - keys) | (proof.keys() - parts)),
        ("lacks the", (keys - content.keys()) | (parts - proof.keys())),
    ):
        if wrong:
            return f"it {word} keys {quoted(sorted(map(str, wrong)))}"
    if content["sha256"] != _checksum(content):
        return "it was changed after it was made: its checksum differs"
    if content["weights"] != weights:
        return "it is about other weights: their sha256 differs"
    return None


def signed(content: Mapping[str, Any], claims: dict[str, Any]) -> str | None:
    """Why the claims of a certificate are refused: they must be those that follow from the weights and the proof."""
    claims = {**claims, "path": str(content["path"])}
    claims["versions"] = {str(key): str(value) for key, value in content["versions"].items()}
    if wrong := [
        key for key, value in claims.items() if type(content[key]) is not type(value) or content[key] != value
    ]:
        return f"its {', '.join(wrong)}: the claim does not follow from the weights"
    return None


def described(claims: dict[str, Any], parts: dict[str, Any], path: str) -> dict[str, Any]:
    """A certificate's content, with its checksum, from its claims and the parts of its proof."""
    content = {
        **claims,
        "proof": parts,
        "path": path.encode("utf-8", "backslashreplace").decode(),  # a file name may contain bytes that are not text
        "versions": _versions(),
    }
    content["sha256"] = _checksum(content)
    return content


def _claims(weights: ShallowWeights, condition: str, kappa: Fraction, proof: Mapping[str, Any]) -> dict[str, Any]:
    """The claims of a certificate, derived from the weights, the condition, the rate and the box."""
    bound = kappa * Fraction(exact.CORNER.get(condition, 2), 2)  # M with Λ in the corner at κ: slopes in [0, 2], κ/2
    where, how = "for all x₁, x₂ and u", "M(p, Λ) is positive definite: LDLᵀ in rational arithmetic"
    margin = 1 - kappa
    if condition in CLOSED_FORMS:
        margin = exact.condition(condition, weights.a, weights.w1).margin
    else:
        invariant = proof["invariance_tree"] is not None
        lo, hi = box_of(proof["box"])
        intervals = ", ".join(
            f"[{Decimal(least)}, {Decimal(most)}]" for least, most in zip(lo, hi, strict=True)
        )  # exact
        extent = "which f maps into itself" if invariant else "for as long as x stays in it"
        where = f"for (x, u) in {intervals}, {extent}"
        how = "interval bounds on every box of the tree, in rational arithmetic"
    n, m = weights.W2.shape
    return {
        "format": FORMAT,
        "claim": f"|f(x₁, u) − f(x₂, u)| {'<' if bound == 1 else '≤'} {above(bound, DIGITS + 1)} |x₁ − x₂| {where}",
        "weights": digest(weights),
        "neurons": n,
        "inputs": m,
        "condition": condition,
        "rate": str(kappa),
        "margin": float_below(margin),
        "contraction_rate": str(bound),
        "verified": how,
    }


def fraction(text: Any) -> Fraction:
    """A fraction p/q in plain digits only: "1e999999999" would be short to write and slow to compute."""
    if not (isinstance(text, str) and FRACTION.fullmatch(text)):
        raise ValueError(f"found {quoted(text)}, expected a fraction p/q")
    return Fraction(text)


def pairs(box: Box) -> list[list[str]]:
    """The ends of a box as fractions."""
    return [[str(Fraction(float(lo))), str(Fraction(float(hi)))] for lo, hi in zip(box.lo, box.hi, strict=True)]


def box_of(given: list[list[str]]) -> Box:
    """A box from its pairs of fractions; the first of them is of x."""
    if not (isinstance(given, list) and all(isinstance(pair, list) for pair in given)):
        raise TypeError("the box is no list of pairs")
    ends = [[fraction(x) for x in pair] for pair in given]
    if any(len(pair) != 2 or pair[0] > pair[1] or any(Fraction(float(x)) != x for x in pair) for pair in ends):
        raise ValueError("the box's ends are no floats in order")
    if ends[0][0] == ends[0][1]:
        raise ValueError("x has no width: a rate compares two states")
    lo, hi = np.array([[float(x) for x in pair] for pair in ends]).T
    return Box(lo.copy(), hi.copy())


def _checksum(content: Mapping[str, Any]) -> str:
    text = json.dumps({key: value for key, value in content.items() if key != "sha256"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _versions() -> dict[str, str]:
    try:
        ours = version("usvlearn")
    except PackageNotFoundError:
        ours = "unknown"
    return {"usvlearn": ours, "python": platform.python_version(), "numpy": np.__version__}


def write(path: str | Path, certificate: Mapping[str, Any]) -> Path:
    """Write a certificate to a file, completely or not at all.

    Args:
        path: of the file; missing folders are made.
        certificate: such as `make` returns.

    Returns:
        The path.

    Raises:
        CertifyError: it cannot be written.

    >>> import tempfile
    >>> proved = make(ShallowWeights([0.5], [1.0], [[0.0]], [0.0]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     read(write(f"{folder}/half.json", proved)) == proved
    True
    """
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_text(json.dumps(certificate, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        os.replace(unfinished, path)
    except OSError as error:
        raise CertifyError(
            f"{path}: cannot be written ({error.strerror}): give a folder that can be written"
        ) from error
    return path


def read(path: str | Path) -> dict[str, Any]:
    """Read a certificate. Only repeated keys are checked here; `verify` checks the rest.

    Args:
        path: of the file.

    Returns:
        The certificate as it stands in the file.

    Raises:
        CertifyError: no such file, too large, or not a JSON object.

    >>> read("nowhere.json")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    certify.errors.CertifyError: nowhere.json: cannot be read (No such file or directory): give ...
    """
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise ValueError(f"it has more than {LARGEST} bytes")
        content = json.loads(data.decode("utf-8"), object_pairs_hook=_once, parse_constant=_no_number)
    except OSError as error:
        raise CertifyError(f"{path}: cannot be read ({error.strerror}): give the path of a certificate") from error
    except (ValueError, RecursionError) as error:
        raise CertifyError(
            f"{path}: is no certificate ({shortened(error)}): give a JSON file that --certificate has written"
        ) from error
    if not isinstance(content, dict):
        raise CertifyError(f"{path}: found a JSON {type(content).__name__}, expected a certificate")
    return content


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {quoted(twice)} appears twice")
    return content


def _no_number(name: str) -> Any:
    raise ValueError(f"found {name}, expected a number")
