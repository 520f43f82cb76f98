"""Parts of the batch fit: derivatives, priors, intervals and limits against closed forms and finite differences."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from tests.support.fitted_boats import MASS, TOP, boat, mission
from usvlearn.core.prepared_samples import LEARN, LEFT, MODE, PREDICT, RIGHT, SURGE
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.model.fit import motion_kernel as kernel
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.gauss_newton import Fit, Missions, legal
from usvlearn.model.fit.intervals import alike, gradients, intervals, own_error, spread, unreached
from usvlearn.model.fit.open_loop import usual_current
from usvlearn.model.fit.quantities import CurvedAhead, quantities
from usvlearn.model.fit.shown import tables
from usvlearn.model.fit.terms import AT, DRAG_NODES, NAMES, PLACE_LAG, PLACE_TIME, SETS, THRUST_NODES, prior

CROOKED = 0.04321  # commands beside the nodes, where curves have no slope


@pytest.mark.parametrize("w", [1.3, 0.4, -0.7])
def test_a_step_moves_with_the_lag_and_with_its_speed(w):
    theta, away, gradient = boat(), (0.3, -0.5), np.zeros(len(NAMES))

    def stepped(by, w=w):
        W, V = np.zeros((2, len(NAMES)))
        commands = tuple(x + by * d for x, d in zip((0.43, -0.21), away, strict=True))
        push, late = kernel.pushed(theta, commands, away, W)
        return kernel.moved(theta, TOP, w, push, late, (0.0, 0.0, 0.0), 0.4, 0.1, W, V, gradient)

    _, through = stepped(0.0)
    slope, step = gradient[PLACE_LAG], 1e-6
    assert slope == pytest.approx((stepped(step)[0] - stepped(-step)[0]) / (2 * step), rel=1e-5)
    assert through == pytest.approx((stepped(0.0, w + step)[0] - stepped(0.0, w - step)[0]) / (2 * step), rel=1e-5)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_slope_of_thrust_is_that_of_its_curve(side):
    ahead, x = CurvedAhead(boat(), TOP), np.linspace(-1, 1, 21) + CROOKED
    slope = (ahead.thrust(x + 1e-6, side) - ahead.thrust(x - 1e-6, side)) / 2e-6
    np.testing.assert_allclose(ahead.thrust_slope(x, side), slope, rtol=1e-6)


def test_the_motion_changes_with_the_speed_as_it_says():
    ahead, v = CurvedAhead(boat(), TOP), TOP * (np.linspace(0, 1.1, 12) + CROOKED)
    f, slope = ahead.motion(v, 0.6)
    up, down = (ahead.motion(v + sign * 1e-6, 0.6)[0] for sign in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-6)
    push = sum(ahead.thrust(0.6, side) for side in ("left", "right"))
    np.testing.assert_allclose(f, push + 0.6 * ahead.lift * v - ahead.drag(v), rtol=1e-9)


@pytest.mark.parametrize("terms", SETS)
@pytest.mark.parametrize("top", [1.0, 4.0])
def test_the_prior_is_a_boat_that_reaches_its_top_speed_with_a_time_constant(terms, top):
    """2.5 s for a small departure from the top speed; half of the thrust is linear in the command."""
    known = prior(terms, top)
    linear, quadratic = (known.mean[AT[f"drag_{kind}"]] for kind in ("linear", "quadratic"))
    assert -1 / (linear + 2 * quadratic * top) == pytest.approx(2.5)
    ahead = CurvedAhead(known.mean, top)
    assert ahead.steady_speed(1.0) == pytest.approx(top)
    assert ahead.thrust(0.5, "left") == pytest.approx(0.375 * ahead.thrust(1.0, "left"))
    assert {NAMES[place] for place in known.active} == set(SETS[terms])
    assert not known.mean[np.setdiff1d(np.arange(len(NAMES)), known.active)].any()


def test_nodes_of_the_prior_are_alike_where_they_are_near():
    """A node deviates by 15 % of full thrust, or 20 % of full drag, and 1 % of the variance is its own."""
    known = prior("curves", TOP)
    covariance, full = np.linalg.inv(known.information), CurvedAhead(known.mean, TOP).thrust(1.0, "left")
    named = {NAMES[place]: k for k, place in enumerate(known.active)}
    for name, share, nodes in (
        ("thrust_node_right_astern", 0.15, THRUST_NODES), ("drag_node", 0.2, DRAG_NODES),
    ):  # fmt: skip
        places = [named[f"{name}_{node:g}"] for node in nodes]
        apart = (nodes[:, None] - nodes) / 0.35
        expected = (share * full) ** 2 * (np.exp(-(apart**2) / 2) + 0.01 * np.eye(len(nodes)))
        np.testing.assert_allclose(covariance[np.ix_(places, places)], expected, rtol=1e-6, atol=1e-12)
        others = np.setdiff1d(np.arange(len(covariance)), places)
        assert np.abs(covariance[np.ix_(places, others)]).max() < 1e-12


def fit_of(terms: str = "cubic", count: int = 3) -> Fit:
    """A fit whose information and scores are drawn, of a boat whose terms are those of the prior."""
    known, rng = prior(terms, TOP), np.random.default_rng(3)
    m = len(known.active)
    root, score = 5 * rng.standard_normal((count, m, m)), rng.standard_normal((count, m))
    information = root @ root.transpose(0, 2, 1)
    return Fit(terms, TOP, known.mean.copy(), known, np.zeros(count), np.ones(count), score, information, 0.02)


def test_gradients_are_those_of_closed_forms():
    """Thrust is linear in its parameters; of a steady speed it is that of an implicit function."""
    fit = fit_of()
    slopes, named = gradients(fit, MASS), [NAMES[place] for place in fit.known.active]
    for name, value in zip(named, slopes["thrust_full_left"], strict=True):
        assert value == pytest.approx(MASS * (name in [f"thrust_{x}_left" for x in ("linear", "quadratic", "cubic")]))
    slope = 1 / 2.5 - CurvedAhead(fit.theta, TOP).lift
    acts = {
        "drag_quadratic": TOP**2,
        "drag_linear": TOP,
        "drag_cross": 0.0,
        "command_lag": 0.0,
        "thruster_time_constant": 0.0,
    }
    for name, value in zip(named, slopes["steady_speed_full"], strict=True):
        force = acts.get(name, TOP if "speed" in name else 1.0)
        assert value == pytest.approx(force / slope, rel=0.02, abs=1e-9), name


def test_an_interval_adds_the_spread_the_disagreement_and_the_own_error():
    fit, other = fit_of(), fit_of()
    other.theta[AT["thrust_linear_left"]] += 0.05
    far = fit_of()
    far.theta[AT["thrust_linear_left"]] += 9.0
    fits = {"cubic": fit, "even": other, "nine": far}
    scores = {name: Score(np.zeros(3), gain, 0.01) for name, gain in (("cubic", 0), ("even", -0.02), ("nine", -0.021))}
    assert alike(scores, "cubic") == ["even"]
    thrust = intervals(fits, scores, "cubic", MASS)["thrust_full_left"]
    A = np.linalg.inv(fit.information.sum(0) + fit.known.information)
    away = fit.score - fit.score.mean(0)
    S = A + (1.0 + 9.0 / 3) * A @ (3 / 2 * away.T @ away) @ A
    np.testing.assert_allclose(spread(fit), S, rtol=1e-9)
    named = [NAMES[place] for place in fit.known.active]
    slope = MASS * np.array([name in [f"thrust_{x}_left" for x in ("linear", "quadratic", "cubic")] for name in named])
    value = MASS * TOP * (0.5 / 2.5 + 0.25 / 2.5) / 2
    deviation = math.sqrt(slope @ S @ slope + (MASS * 0.05) ** 2 + (0.015 * value) ** 2)
    assert thrust.value == pytest.approx(value) and thrust.unit == "N"
    assert thrust.high == pytest.approx(value + 1.645 * deviation, rel=1e-3)
    assert thrust.low == pytest.approx(value - 1.645 * deviation, rel=1e-3)
    one = fit_of(count=1)
    np.testing.assert_allclose(spread(one), one.covariance)


def test_what_depends_on_a_command_that_was_not_reached_has_a_wider_interval():
    """30 s beyond a command are enough to know it; without, each tenth adds 3.5 % to a steady speed's deviation."""
    rows = mission(1000)
    rows[1:, LEFT], rows[1:, RIGHT] = 0.7, 0.3
    rows[1:200, [LEFT, RIGHT]] = 0.8
    assert unreached(Missions([rows], TOP)) == pytest.approx(0.2)
    rows[1:150, [LEFT, RIGHT]] = 1.0
    assert unreached(Missions([rows], TOP)) == pytest.approx(0.2)
    rows[1:152, [LEFT, RIGHT]] = 1.2
    assert unreached(Missions([rows], TOP)) == 0.0
    fit = fit_of()
    scores = {"cubic": Score(np.zeros(3), 0.0, 0.01)}
    near, far = (intervals({"cubic": fit}, scores, "cubic", MASS, beyond) for beyond in (0.0, 0.2))
    wide, wider = (each["steady_speed_full"].high - each["steady_speed_full"].low for each in (near, far))
    assert wider**2 - wide**2 == pytest.approx((2 * 1.645 * 0.07 * TOP) ** 2, rel=1e-2)
    assert near["steady_speed_half"] == far["steady_speed_half"]


def test_own_errors_are_shares_of_what_the_terms_add_up_to():
    values = {"steady_speed_full": 2.0, "drag_half_speed": 3.0, "thrust_full_right": 8.0, "stopping_distance": 5.0}
    expected = {"drag_linear": 0.05 * 6 / 2, "drag_quadratic": 0.13 * 6 / 4, "thrust_linear_right": 0.03 * 8,
                "thrust_quadratic_right": 0.045 * 8, "thrust_speed_right": 0.03 * 8 / 2, "stopping_distance": 0.15,
                "thrust_full_right": 0.12}  # fmt: skip
    for name, error in expected.items():
        assert own_error(name, values) == pytest.approx(error), name
    assert own_error("drag_linear", values | {"steady_speed_full": math.nan}) == 0


def test_limits_leave_what_is_legal_and_move_what_is_not():
    """The lag lies within −0.5 … 1.5, a time constant within 0.02 … 5 s; drag brakes, at either sign of the speed."""
    for terms in SETS:
        known = prior(terms, TOP)
        covariance = np.linalg.inv(known.information)
        theta = known.mean.copy()
        theta[PLACE_LAG] = 0.3 * (PLACE_LAG in known.active)
        np.testing.assert_array_equal(legal(theta.copy(), known, covariance), theta)
        for lag, limit in ((-0.6, -0.5), (1.6, 1.5), (-0.4, -0.4), (1.4, 1.4)):
            theta[PLACE_LAG] = lag
            assert legal(theta.copy(), known, covariance)[PLACE_LAG] == limit
        for time, limit in ((0.001, 0.02), (7.0, 5.0), (0.3, 0.3)):
            theta[PLACE_TIME] = time
            assert legal(theta.copy(), known, covariance)[PLACE_TIME] == limit
        theta[AT["drag_quadratic"]], theta[AT["drag_even"]] = 0.1, 0.2 * (AT["drag_even"] in known.active)
        moved = legal(theta.copy(), known, covariance)
        assert moved[AT["drag_quadratic"]] + abs(moved[AT["drag_even"]]) <= 1e-9


def test_a_current_that_differs_more_than_its_mean_is_not_expected():
    """Its size is 1 − variance of the mean / mean², 0 at least (James & Stein 1961)."""
    assert usual_current(np.array([[0.1, 0.0], [0.3, 0.0]])).tolist() == pytest.approx([0.2 * (1 - 0.02 / 2 / 0.04), 0])
    for apart in ([[0.5, 0.0], [-0.3, 0.0]], np.zeros((3, 2))):
        assert usual_current(np.array(apart)).tolist() == [0, 0]
    assert usual_current(np.array([[0.3, 0.1]])).tolist() == [0.3, 0.1]


def test_measured_steps_of_a_boat_that_moves_are_counted():
    rows = mission(60)
    rows[1:, MODE], rows[1:, SURGE] = LEARN, 0.4
    rows[30:40, MODE] = PREDICT
    resting = rows.copy()
    resting[:, [LEFT, RIGHT, SURGE]] = 0.0
    sailed = Missions([rows, rows[:1], resting], TOP, ["a", "b", "c"])
    assert sailed.steps == [50, 0, 0]
    fit = sailed.evaluate("nine", prior("nine", TOP).mean, 0.1)
    assert fit.count.tolist() == [50, 0, 0] and fit.loss[0] != 0 and fit.loss[1:].tolist() == [0, 0]
    assert not fit.score[1:].any() and not fit.information[1:].any()
    assert (fit.information[0] == fit.information[0].T).all() and np.linalg.eigvalsh(fit.information[0])[0] > -1e-9


def found_boat(quantities_: dict[str, Quantity], doubts: tuple[str, ...] = ()) -> SimpleNamespace:
    """What `tables` reads of a fitted boat."""
    boat = SimpleNamespace(
        displayed=quantities_.__getitem__, scale="By a mass of 28 kg.", late=0.3, lacks=("It never turned.",)
    )
    fits = {"nine": fit_of("nine", 2), "cubic": fit_of("cubic", 2)}
    return SimpleNamespace(
        boat="heron", missions=SimpleNamespace(number=2), doubts=doubts, quantities=quantities_,
        identified=boat, fits=fits, fit=fits["cubic"], chosen="cubic", simulation=None,
        scores={"nine": Score(np.zeros(2), -0.5, math.inf), "cubic": Score(np.zeros(2), 0.0, 0.0)},
        errors={"nine": 0.0512, "cubic": 0.0341},
    )  # fmt: skip


def test_the_tables_of_a_fit_have_a_cell_for_each_head():
    """Also where the ensemble knows nothing of a quantity, or there is no ensemble."""
    known = {"drag_linear": Quantity(1.0, 0.5, 2.0, "kg/s"), "time_constant": Quantity(2.5, 2.0, 3.0, "s")}
    online = {"drag_linear": Quantity(1.5, math.nan, math.inf, "kg/s")}
    beside = type("Online", (), {"displayed": staticmethod(online.__getitem__), "__contains__": online.__contains__})()
    for ensemble, cells in (
        (beside, [["1.00", "0.500", "2.00", "1.50", "–", "inf", "kg/s"], ["2.50", "2.00", "3.00", "–", "–", "–", "s"]]),
        (None, [["1.00", "0.500", "2.00", "kg/s"], ["2.50", "2.00", "3.00", "s"]]),
    ):  # fmt: skip
        table, _, sets, *lines = tables(found_boat(known), ensemble)
        assert all(len(row) == len(table.head) for row in table.rows)
        assert [[str(cell) for cell in row[1:]] for row in table.rows] == cells
        assert [[str(cell) for cell in row] for row in sets.rows] == [
            ["nine", "10", "0.5000", "–", "0.0512"], ["cubic (used)", "13", "–", "–", "0.0341"],
        ]  # fmt: skip
        said = "\n".join(map(str, lines))
        assert "2 missions err by 0.0341 m/s; speeds are 0.3 s late." in said and "Use the values of the fit" in said
        console = Console(width=160)
        with console.capture() as caught:
            console.print(table)
        assert "time_constant" in caught.get()
    table, _, _, *lines = tables(found_boat(known, ("The lag is at its bound.",)), None)
    assert "Use the values" not in (said := "\n".join(map(str, lines))) and "(use)" not in str(table.head)
    assert "Do not use the values of the fit before this is settled:\nThe lag is at its bound." in said


def test_quantities_of_the_prior_are_closed_forms():
    """Drag l v + q v² and thrust full (ξ + ξ²)/2 of each side, without curves."""
    values, full = quantities(prior("nine", TOP).mean, TOP, MASS), MASS * TOP * 0.3 / 2
    linear, quadratic = MASS * 0.2, MASS * 0.1 / TOP
    half = linear * TOP / 2 + quadratic * TOP**2 / 4
    expected = {
        "drag_linear": -linear, "drag_quadratic": -quadratic, "thrust_full_left": full, "thrust_linear_right": full / 2,
        "thrust_quadratic_right": full / 2, "thrust_ratio": 1.0, "steady_speed_full": TOP, "drag_half_speed": half,
        "time_constant": MASS / (linear + quadratic * TOP),
        "steady_speed_half": (-linear + math.sqrt(linear**2 + 4 * quadratic * 2 * full * 0.375)) / (2 * quadratic),
    }  # fmt: skip
    for name, value in expected.items():
        assert float(values[name]) == pytest.approx(value, rel=1e-6), name
