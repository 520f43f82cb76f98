"""Equilibria are exact: place, number and class agree with brute force in fractions that shares no code with them."""

import io
import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from certify.display.figures import MARKS, equilibria_figure
from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs.equilibria import CLASSES, equilibria, piecewise, surge_inputs, sweep
from tests.support import cases, few

DOMAINS = ((0.0, 1.0), (0.0, 0.5), (-1.0, 1.0), (0.25, 0.25), (-3.0, 0.1))


def network(a, w1, b) -> ShallowWeights:
    """A network without inputs to speak of: W₂ = 0, m = 1."""
    return ShallowWeights(np.array(a, float), np.array(w1, float), np.zeros((len(a), 1)), np.array(b, float))


def found(weights: ShallowWeights, u=(0.0,), **domain) -> list[tuple[float, float, str]]:
    return [(each.lo, each.hi, each.kind) for each in equilibria(weights, u, **domain)]


def brute_force(weights: ShallowWeights, u, lo: float, hi: float) -> list[tuple]:
    """As `equilibria`, by evaluating the network in fractions, and classes by four steps from either side."""
    a, w, b = ([Fraction(x) for x in part.tolist()] for part in (weights.a, weights.w1, weights.b))
    c = [
        bi + sum(Fraction(v) * Fraction(x) for v, x in zip(row, u, strict=True))
        for bi, row in zip(b, weights.W2.tolist(), strict=True)
    ]

    def f(x: Fraction) -> Fraction:
        return sum((ai * max(wi * x + ci, Fraction(0)) for ai, wi, ci in zip(a, w, c, strict=True)), Fraction(0))

    knots = {-ci / wi for wi, ci in zip(w, c, strict=True) if wi}
    ends = Fraction(lo), Fraction(hi)
    points = sorted({*ends} | {t for t in knots if ends[0] < t < ends[1]})
    roots = [(p, p) for p in points if f(p) == p]
    for p, q in pairwise(points):
        drop_p, drop_q = f(p) - p, f(q) - q
        if drop_p == drop_q == 0:
            roots.append((p, q))
        elif drop_p * drop_q < 0:
            x = p + (q - p) * drop_p / (drop_p - drop_q)
            assert f(x) == x
            roots.append((x, x))
    merged: list[tuple[Fraction, Fraction]] = []
    for left, right in sorted(roots):
        if merged and left <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(right, merged[-1][1])
        else:
            merged.append((left, right))
    steepest = 1 + sum(abs(ai * wi) for ai, wi in zip(a, w, strict=True))
    known = []
    for left, right in merged:
        room = min((abs(t - x) for t in knots for x in (left, right) if t != x), default=Fraction(1))
        step = room / steepest**5
        slope_left, slope_right = (left - f(left - step)) / step, (f(right + step) - right) / step
        if left < right:
            kind = "continuum"
            outside = ((left - step, left), (right + step, right))
            attracts = all(f(f(x)) == f(x) or abs(f(x) - end) < step for x, end in outside)
        else:
            kind, attracts = class_by_simulation(f, left, step)
        known.append((float(left), float(right), kind, float(slope_left), float(slope_right), attracts))
    return known


def class_by_simulation(f, x: Fraction, step: Fraction) -> tuple[str, bool]:
    """How deviations from x behave from the second step on to the fourth."""
    fates, jumps, fixed = [], [], []
    for start in (-step, step):
        d = [start]
        for _ in range(4):
            d.append(f(x + d[-1]) - x)
        fates.append("met" if d[2] == 0 else "near" if abs(d[4]) < abs(d[2]) else "far" if d[4] != d[2] else "same")
        jumps.append(d[1] * d[0] < 0)
        fixed.append(d[1] == d[0])
    if any(fixed):
        return "continuum", "far" not in fates
    if all(jumps):
        kinds = {"near": "stable oscillatory", "same": "neutral two-cycles", "far": "unstable oscillatory"}
        assert fates[0] == fates[1]
        return kinds[fates[0]], fates[0] == "near"
    if set(fates) == {"met"}:
        return "deadbeat", True
    if "far" not in fates:
        return "stable", True
    return ("unstable" if set(fates) == {"far"} else "half-stable"), False


def random_network(rng: np.random.Generator, degenerate: bool) -> tuple[ShallowWeights, np.ndarray]:
    n, m = int(rng.integers(1, 8)), int(rng.integers(1, 4))
    if degenerate:
        draw = lambda *shape: rng.integers(-4, 5, shape) / 2.0 ** rng.integers(0, 3)  # noqa: E731
    else:
        draw = lambda *shape: rng.normal(size=shape)  # noqa: E731
    return ShallowWeights(draw(n), draw(n), draw(n, m), draw(n)), draw(m) * rng.integers(0, 2)


def compare_with_brute_force(count: int, seed: int) -> dict[str, int]:
    rng = np.random.default_rng(seed)
    seen = dict.fromkeys([*CLASSES, "at a knot"], 0)
    for k in range(count):
        weights, u = random_network(rng, degenerate=k % 2 == 0)
        lo, hi = DOMAINS[rng.integers(len(DOMAINS))] if k % 3 == 0 else DOMAINS[0]
        got = equilibria(weights, u, lo, hi)
        assert [tuple(each) for each in got] == brute_force(weights, u, lo, hi), (weights, u, lo, hi)
        for each in got:
            seen[each.kind] += 1
            seen["at a knot"] += each.slope_left != each.slope_right
    return seen


@cases(600, 1500)
def test_brute_force_agrees_bit_for_bit(count):
    seen = compare_with_brute_force(count, seed=0)
    assert all(seen.values()), seen  # every class was met


@pytest.mark.parametrize("decades", few([12, 150], [150], "thorough"))
def test_weights_of_many_magnitudes(decades):
    rng = np.random.default_rng(2)
    count = 0
    for _ in range(100):
        n = int(rng.integers(2, 7))
        size = lambda *shape: 10.0 ** rng.uniform(-decades, decades, shape) * rng.choice([-1, 1], shape)  # noqa: E731
        w1 = size(n)
        weights = ShallowWeights(size(n), w1, size(n, 2), -w1 * rng.uniform(0, 1, n))
        u = np.where(rng.random(2) < 0.8, 0.0, 10.0 ** rng.uniform(-decades, decades, 2))
        got = [tuple(each) for each in equilibria(weights, u)]
        assert got == brute_force(weights, u, 0.0, 1.0)
        count += len(got)
    assert count > 50


def test_slopes_beyond_the_range_of_floats():
    """¼ up to x = 1, then a slope of 10⁴⁰⁰."""
    rest, steep = equilibria(network([1e200, 1.0], [1e200, 0.0], [-1e200, 0.25]), [0.0], hi=2.0)
    assert rest == (0.25, 0.25, "deadbeat", 0.0, 0.0, True)
    assert steep == (1.0, 1.0, "unstable", math.inf, math.inf, False)


def zigzag(n: int) -> ShallowWeights:
    """The map through (0, 0) and points by turns below and above the identity line."""
    t = np.arange(n + 2) / (n + 1)
    y = t + 0.5 / (n + 1) * (-1.0) ** np.arange(n + 2)
    y[:2] = 0
    slopes = np.diff(y) / np.diff(t)
    return network(np.diff(slopes), np.ones(n), -t[1:-1])


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_a_network_of_n_neurons_has_up_to_n_plus_1_equilibria(n):
    got = equilibria(zigzag(n), [0.0])
    assert len(got) == n + 1 and all(each.lo == each.hi for each in got)
    assert got[0].kind == "deadbeat" and {each.kind for each in got[1::2]} == {"unstable"}


def test_the_identity_map_is_one_interval():
    (each,) = equilibria(network([1.0], [1.0], [0.0]), [0.0])
    assert each[:3] == (0.0, 1.0, "continuum") and each.x == 0.5 and each.attracts
    assert each.slope_left == 0 and each.slope_right == 1  # it goes on beyond 1
    assert found(network([1.0], [1.0], [0.0]), lo=-1.0, hi=0.0) == [(0.0, 0.0, "continuum")]  # the end of one


def test_an_interval_and_what_happens_beside_it():
    """x up to ½, then away from the line: 3x − 1 leaves the interval, ½ comes to it."""
    leaves, comes = network([1.0, 2.0], [1.0, 1.0], [0.0, -0.5]), network([1.0, -1.0], [1.0, 1.0], [0.0, -0.5])
    for weights, attracts, slope in ((leaves, False, 3.0), (comes, True, 0.0)):
        (each,) = equilibria(weights, [0.0])
        assert each == (0.0, 0.5, "continuum", 0.0, slope, attracts)


def test_a_float_is_taken_literally():
    """0.1 · 10 is above 1 by less than a rounding: no interval, but an unstable point that looks like one."""
    above, below = network([0.1], [10.0], [0.0]), network([0.1], [math.nextafter(10.0, 0)], [0.0])
    assert [each.kind for each in equilibria(above, [0.0])] == ["half-stable"]
    assert equilibria(above, [0.0])[0].slope_right == 1.0
    assert [each.kind for each in equilibria(below, [0.0])] == ["stable"]


def test_zero_has_no_sign():
    (each,) = equilibria(network([2.0, -2.0], [1.0, 0.0], [1.0, 1.0]), [0.0], lo=-0.5)  # f = 2x
    assert each.kind == "unstable" and math.copysign(1, each.x) == 1


def test_the_piecewise_map_is_the_network():
    rng = np.random.default_rng(4)
    for _ in range(50):
        weights, u = random_network(rng, degenerate=False)
        a, w1, W2, b = weights
        x, y, slopes = piecewise(weights, u, -1.0, 2.0)
        assert x[0] == -1 and x[-1] == 2 and (np.diff(x) > 0).all() and len(slopes) == len(x) - 1
        inside = np.sort(-(W2 @ u + b) / w1)
        np.testing.assert_allclose(x[1:-1], inside[(inside > -1) & (inside < 2)], rtol=1e-12)
        at = np.linspace(-1, 2, 101)
        np.testing.assert_allclose(np.interp(at, x, y), np.maximum(np.outer(at, w1) + W2 @ u + b, 0) @ a, atol=1e-12)
        np.testing.assert_allclose(np.diff(y), slopes * np.diff(x), atol=1e-12)


def test_sweep_is_every_input_by_itself():
    rng = np.random.default_rng(6)
    weights = ShallowWeights(*(rng.normal(size=shape) for shape in ((20,), (20,), (20, 4), (20,))))
    inputs = surge_inputs(np.linspace(0, 2 * np.pi, 8), 0.25, 0.5)
    got = sweep(weights, inputs)
    assert got == [equilibria(weights, u) for u in inputs] and any(got)


def test_the_inputs_of_a_heading():
    np.testing.assert_allclose(surge_inputs(np.pi / 2, 0.25, [0.5, -1.0]), [[1, 0.5, 0.25, 0.5], [1, 0.5, 0.25, -1]])


@pytest.mark.parametrize(
    ("weights", "u", "domain", "told"),
    [
        (network([1], [1], [0]), [0.0, 0.0], {}, r"\(2,\), expected \(1,\)"),
        (network([1], [1], [0]), 0.0, {}, r"expected \(1,\)"),
        (network([1], [1], [0]), ["east"], {}, "no array of numbers"),
        (network([1], [1], [0]), [math.nan], {}, "NaN"),
        (network([1], [1], [0]), [0.0], {"lo": 2.0}, "lo <= hi"),
        (network([1], [1], [0]), [0.0], {"hi": math.inf}, "finite"),
        (network([1], [1], [0]), [0.0], {"lo": math.nan}, "finite"),
        (network([math.nan], [1], [0]), [0.0], {}, "NaN"),
        (network([], [], []), [], {}, "without neurons"),
        (network([1, 1], [1], [0]), [0.0], {}, "shapes"),
        (ShallowWeights(np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 3, 1)), np.ones((2, 3))), [0.0], {}, "batch"),
    ],
)
def test_bad_input_is_told_in_a_sentence(weights, u, domain, told):
    with pytest.raises(CertifyError, match=told):
        equilibria(weights, u, **domain)


def drawn(weights: ShallowWeights, u, **given):
    """The lines of the figure by the first line of their label; every figure is also rendered."""
    pytest.importorskip("matplotlib")
    figure = equilibria_figure(weights, u, "A figure", **given)
    figure.savefig(io.BytesIO(), format="png", dpi=40)
    return {str(line.get_label()).split("\n")[0]: line for line in figure.axes[0].get_lines()}


def test_the_figure_shows_the_map_its_critical_points_and_each_class():
    assert set(MARKS) == set(CLASSES)
    lines = drawn(zigzag(5), [0.0])
    assert lines["critical points"].get_xdata().tolist() == pytest.approx(np.arange(1, 6) / 6)
    assert lines["map"].get_ydata()[-1] == pytest.approx(1 + 1 / 12)
    assert lines["unstable"].get_label() == "unstable\nx = 0.2778\nx = 0.5833\nx = 0.9167"
    interval = drawn(network([1.0, 2.0], [1.0, 1.0], [0.0, -0.5]), [0.0])["continuum"]
    assert interval.get_xdata().tolist() == interval.get_ydata().tolist() == [0.0, 0.5]


def test_the_figure_fills_the_side_from_which_states_come():
    left = network([1.5, 0.5], [1.0, 1.0], [0.0, -0.5])  # slopes 1.5 and 2 through 0: q_L = 0 comes, q_R = 1.5 leaves
    right = network([2.0, -1.5, 1.0], [1.0, 1.0, 0.0], [-0.25, -0.5, 0.0])  # at ½, from 2 to ½
    assert drawn(left, [0.0])["half-stable"].get_fillstyle() == "left"
    assert drawn(right, [0.0])["half-stable"].get_fillstyle() == "right"


def test_the_figure_of_several_headings_and_of_nothing():
    headings = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    weights = ShallowWeights([0.5, 0.1], [1.0, 0.0], [[0.0] * 4, [1.0, 1.0, 0.0, 0.0]], [0.0, 0.0])
    lines = drawn(weights, surge_inputs(headings), headings=headings)
    assert "8 maps" in lines and lines["stable"].get_label().startswith("stable\n8 from x = 0.0586 to ")
    assert "no equilibrium here" in drawn(network([1.0], [0.0], [2.0]), [0.0])
    with pytest.raises(CertifyError, match="headings: found none for 8 inputs"):
        equilibria_figure(weights, surge_inputs(headings), "Without headings")
    with pytest.raises(CertifyError, match="lo < hi"):
        equilibria_figure(weights, surge_inputs(0.0), "A point", lo=1.0)
