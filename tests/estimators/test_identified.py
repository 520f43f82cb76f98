"""What a joint EKF has identified: its quantities, their intervals, and what a log lacks."""

import json
import math

import numpy as np
import pytest
import torch

from tests.support.known_boats import MASS, THETA_ODD
from usvlearn import AID, Ensemble, Inputs, JointEKF, Online, Persistence, Sample
from usvlearn.core.events import NINETY
from usvlearn.core.samples import named_leaves
from usvlearn.engine.rollouts import rollout
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.periodic_estimates import Identified, identify
from usvlearn.estimators.joint.quantities import FORCES, SIDES, quantities, sums
from usvlearn.estimators.joint.state import THETA
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.evaluation.diagnostics import as_results, identified_boats

TOP, STEP = 2.7, 0.4
READER = {"disturbance": 0.05, "disturbance_time": 3.0, "current": 0.15, "drift_time": 5000.0, "lag": 0.3}


def averaged(**changed) -> JointEKF:
    return JointEKF(**({"surge_max": TOP, "mass": MASS, "estimate_every": 600.0} | READER | changed))


def leaves_of(state) -> dict[str, np.ndarray]:
    return {name: leaf.detach().numpy().copy() for name, leaf in named_leaves(state)}


def read(joint: JointEKF, **changed) -> Identified:
    """What is identified in the filter's first state, with some leaves replaced."""
    return identify(joint.description(), leaves_of(joint.init()) | {name: np.asarray(x) for name, x in changed.items()})


def log(steps: int, left, right, heading=None, current: float = 0.0, noise: float = 0.02) -> Sample:
    """A boat of THETA_ODD without cubic thrust under some commands, `(steps,)`, measured over ground."""
    rng = np.random.default_rng(0)
    quadratic, linear, _, *sides = THETA_ODD[:9]
    v, speed = 0.0, np.empty(steps)
    for k in range(steps):
        for _ in range(8):
            push = sum(
                a * x + b * x * abs(x) + c * x * abs(v)
                for x, (a, b, c) in zip((left[k], right[k]), (sides[:3], sides[3:]), strict=True)
            )
            v += STEP / 8 * (quadratic * abs(v) * v + linear * v + push)
        speed[k] = v
    heading = 2 * np.pi * np.arange(steps) / 150 if heading is None else np.full(steps, heading)
    surge = speed + current * np.cos(heading) + noise * rng.standard_normal(steps)
    dt, yes = np.full(steps, STEP), np.ones(steps, dtype=bool)
    turn = np.gradient(np.unwrap(heading), STEP)
    columns = (torch.from_numpy(np.asarray(x, dtype=np.float64)) for x in (left, right, heading, turn, dt, surge))
    *inputs, measured = columns
    inputs[-1][0] = 0.0
    fresh = torch.from_numpy(yes)
    return Sample(Inputs(*inputs), measured, fresh, fresh.clone())


def varied(steps: int, low: float = 0.0, high: float = 1.0, seed: int = 1) -> np.ndarray:
    """A command that changes every 4 to 20 s."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(low, high, steps), rng.integers(10, 50, steps))[:steps]


def learned(sample: Sample, **changed) -> Identified:
    joint = averaged(**changed)
    state, _, _ = rollout(joint, joint.init(), sample)
    return identify(joint.description(), leaves_of(state))


def test_an_undefined_steady_speed_leaves_the_other_quantities():
    theta = THETA_ODD.copy()
    theta[:2] = 0.1, 0.5
    mean = np.concatenate([np.zeros(THETA), theta])
    known = read(averaged(even=None), mean=mean, updates=1e9)
    assert math.isnan(known["steady_speed_full"].value) and curves(known) == {}
    assert known["thrust_full_left"].low < MASS < known["thrust_full_left"].high


def test_many_readings_leave_their_own_covariance_and_the_filters():
    """(1): for a sum of parameters, 1.0 here, the half-width is 1.645 m √(wᵀ(P + C)w + 0.1²), as n → ∞."""
    joint = averaged(even=None)
    rng = np.random.default_rng(0)
    root = 0.01 * rng.standard_normal((12, 12))
    leaves = leaves_of(joint.init())
    mean = np.concatenate([leaves["mean"][:THETA], THETA_ODD])
    D = np.full(16, 1e-4)
    changed = {"mean": mean, "reading": THETA_ODD, "spread": root @ root.T, "readings": 1e12, "factor": np.diag(D)}
    known = read(joint, **changed, updates=1e9)
    row = sums(False)["thrust_full_left"]
    half = NINETY * MASS * math.sqrt(row @ (root @ root.T + 1e-4 * np.eye(12)) @ row + 0.1**2)
    value, low, high, unit = known["thrust_full_left"]
    assert (value, unit) == (pytest.approx(MASS * 1.0), "N")
    assert high - value == pytest.approx(half, rel=1e-6) and value - low == pytest.approx(half, rel=1e-6)
    few = read(joint, **changed | {"readings": 4.0}, updates=1e9)["thrust_full_left"]
    expected = NINETY * MASS * math.sqrt(row @ (2 * root @ root.T + 3e-4 * np.eye(12)) @ row + 0.1**2)
    assert few.high - few.value == pytest.approx(expected, rel=1e-6)


def test_before_the_first_reading_intervals_are_wider_and_shrink():
    joint = averaged(even=None)
    mean = np.concatenate([np.zeros(THETA), THETA_ODD])
    factor = np.diag(np.full(16, 1e-4))
    first, later = (
        read(joint, mean=mean, factor=factor, learned=t, updates=1e9)["thrust_full_left"] for t in (0.0, 2000.0)
    )
    sd = MASS * math.sqrt(3e-4)
    assert first.high - first.value == pytest.approx(NINETY * sd * math.sqrt(5) * 3, rel=1e-6)
    assert later.high - later.value == pytest.approx(NINETY * sd * math.sqrt(5) * (1 + 600 / 2300), rel=1e-6)


def test_an_interval_contains_the_present_estimate():
    joint = averaged(even=None)
    now = THETA_ODD.copy()
    now[3] += 1.0  # a propeller was cleaned
    known = read(
        joint,
        mean=np.concatenate([np.zeros(THETA), now]),
        reading=THETA_ODD,
        readings=30.0,
        factor=np.diag(np.full(16, 1e-6)),
        updates=1e9,
    )
    pull = known["thrust_full_left"]
    assert pull.high == pytest.approx(MASS * 2.0) and pull.value == pytest.approx(MASS)


def test_a_known_force_fixes_the_mass_and_scales_all_forces():
    mean = np.concatenate([np.zeros(THETA), THETA_ODD])
    known = read(averaged(even=None, known={"thrust_full_left": 50.0}), mean=mean)
    assert known["mass"].value == pytest.approx(50.0)  # the pull per mass is 1 N/kg
    assert known["thrust_full_left"].value == pytest.approx(50.0)
    assert known["thrust_full_left"].high - known["thrust_full_left"].low == pytest.approx(0.0, abs=1e-6)
    plain = read(averaged(even=None), mean=mean)
    assert "mass" not in plain and "speeds alone do not tell the mass" in plain.scale
    for name in plain:
        ratio = 50.0 / MASS if name in FORCES else 1.0
        assert known[name].value == pytest.approx(ratio * plain[name].value, rel=1e-6), name
    with pytest.raises(ConfigError, match="known: found 'pull'"):
        averaged(known={"pull": 3.0})
    with pytest.raises(ConfigError, match=r"known.thrust_full_left: found 'x', expected a number"):
        averaged(known={"thrust_full_left": "x"})
    with pytest.raises(ConfigError, match=r"known: found 5, expected {name: value}"):
        averaged(known=5)


def test_a_known_force_of_the_wrong_sign_is_said():
    known = read(averaged(known={"thrust_linear_left": -50.0}))
    assert math.isnan(known["mass"].value) and known.lacks[-1].startswith("known: the forces have the opposite sign")
    right = read(averaged(known={"drag_linear": -10.0}))
    with pytest.raises(ConfigError, match=r"known.thrust_full_left: found -50.0, expected a number that is positive"):
        averaged(known={"thrust_full_right": 30.0, "thrust_full_left": -50.0})
    with pytest.raises(ConfigError, match=r"known.drag_linear: found 10.0, expected a number that is negative"):
        averaged(known={"drag_linear": 10.0})
    assert right["mass"].value > 0 and right.scale.startswith("The mass and all forces follow")


@pytest.fixture(scope="module")
def ordinary() -> Identified:
    return learned(log(4500, varied(4500), varied(4500, seed=2)))


def test_an_ordinary_log_is_identified_with_intervals_that_hold(ordinary):
    truth = quantities(np.concatenate([THETA_ODD[:9], np.zeros(3)]), MASS, np.zeros(12))
    assert ordinary.lacks == ()
    for name in ("drag_half_speed", "steady_speed_full", "steady_speed_half", "time_constant", "stopping_distance"):
        value, low, high, _ = ordinary[name]
        assert low <= truth[name] <= high and high - low < value, name


LACKING = {
    "The left thruster was never used": (lambda n: np.zeros(n), varied, {}, {}),
    "Both thrusters always had the same command": (varied, varied, {}, {}),
    "The boat kept one heading": (varied, lambda n: varied(n, seed=2), {"heading": 0.7, "current": 0.2}, {}),
    "The boat went astern only": (lambda n: -varied(n), lambda n: -varied(n, seed=2), {}, {}),
    "The speed hardly changed: neither": (lambda n: varied(n) - 0.5, lambda n: 0.5 - varied(n), {}, {}),
    "The speed hardly changed": (lambda n: np.full(n, 0.5), lambda n: np.full(n, 0.5), {}, {}),
    "Only 0 steps were learned under way": (lambda n: np.zeros(n), lambda n: np.zeros(n), {}, {}),
    "vehicle.surge_max: found 27 m/s": (varied, lambda n: varied(n, seed=2), {}, {"surge_max": 27.0}),
}


@pytest.mark.parametrize("sentence", LACKING)
def test_what_a_log_lacks_is_said_and_no_interval_is_false(sentence):
    left, right, boat, settings = LACKING[sentence]
    known = learned(log(3000, left(3000), right(3000), **boat), **settings)
    assert any(said.startswith(sentence) for said in known.lacks), known.lacks
    assert not known.unphysical  # what is not known is not negative
    truth = quantities(np.concatenate([THETA_ODD[:9], np.zeros(3)]), MASS, np.zeros(12))
    for name in ("thrust_full_left", "thrust_full_right", "drag_half_speed", "steady_speed_full", "time_constant"):
        assert known[name].low <= truth[name] <= known[name].high, (name, known[name])
    drawn = curves(known)
    ends = {f"thrust_{side}": f"thrust_full_{side}" for side in SIDES} | {"steady_speed": "steady_speed_full"}
    for curve, name in ends.items():
        _, low, high, _ = known[name]
        assert (drawn[curve].low[-1], drawn[curve].high[-1]) == pytest.approx((low, high), rel=1e-6), curve


@pytest.mark.parametrize("speed", [0.0, 1.2])
def test_a_speed_channel_that_is_stuck_is_not_blamed_on_commands_that_vary(speed):
    sample = log(3000, varied(3000), varied(3000, seed=2))
    known = learned(sample._replace(surge=0 * sample.surge + speed))
    assert "check the speed channel" in known.lacks[0]


@pytest.mark.parametrize("low", [0.0, -1.0])
def test_a_reversed_sign_is_named_and_no_interval_is_false(low):
    sample = log(3000, varied(3000, low), varied(3000, low, seed=2))
    known = learned(sample._replace(surge=-sample.surge))
    (said,) = known.lacks
    assert "data.channels.surge.span" in said and "surge_max" not in said
    assert said == known.unphysical and "it has a steady speed at full command of -" in said
    truth = quantities(np.concatenate([THETA_ODD[:9], np.zeros(3)]), MASS, np.zeros(12))
    for name in ("thrust_full_left", "thrust_full_right", "drag_half_speed", "steady_speed_full", "time_constant"):
        assert known[name].low <= truth[name] <= known[name].high, (name, known[name])


@pytest.mark.parametrize("never", SIDES)
def test_a_thruster_that_was_never_used_widens_its_own_interval_alone(ordinary, never):
    commands = (np.zeros(4500), varied(4500)) if never == "left" else (varied(4500), np.zeros(4500))
    known = learned(log(4500, *commands))
    ratio = {name: (known[name].high - known[name].low) / (each.high - each.low) for name, each in ordinary.items()}
    (other,) = set(SIDES) - {never}
    assert ratio[f"thrust_full_{never}"] > 5
    assert ratio[f"thrust_full_{other}"] < 3 and ratio["drag_linear"] < 3


def test_intervals_that_a_log_does_not_settle_are_named():
    """Full thrust is an extrapolation by a factor of three."""
    known = learned(log(3000, varied(3000, 0.0, 0.3), varied(3000, 0.0, 0.3, seed=2)))
    (said,) = known.lacks
    named = said.partition("determined: ")[2].partition(", whose")[0].split(", ")
    for name in set(known) - set(SURGE):
        value, low, high, _ = known[name]
        assert (high - low > abs(value)) == (name in named)
    assert "thrust_full_left" in named


def test_one_step_is_said_in_the_singular():
    assert read(averaged(), updates=1.0).lacks[0].startswith("Only 1 step was learned")


def test_twenty_samples_say_so_and_are_wider_than_the_prior():
    known = learned(log(20, varied(20), varied(20, seed=2)))
    assert known.lacks[0].startswith("Only 19 steps were learned")
    prior = averaged().variance.sqrt().detach()
    single = known["drag_linear"]
    assert single.high - single.low > MASS * NINETY * float(prior[1])


def test_a_filter_that_diverged_identifies_nothing_and_writes_null(tmp_path):
    from usvlearn.runs.files import save_results

    joint = averaged()
    known = read(joint, mean=np.full(23, np.nan))
    assert known.lacks == ("The filter has diverged.",) and curves(known) == {}
    save_results(tmp_path, as_results({"heron": known}, {}))
    text = (tmp_path / "results.json").read_text()
    assert "NaN" not in text and json.loads(text)["identified"]["heron"]["time_constant"]["value"] is None


def test_no_state_raises_or_gives_an_interval_without_its_value():
    rng = np.random.default_rng(0)
    joint = averaged()
    for scale in (0.0, 1e-6, 1.0, 1e3, 1e9):
        mean = scale * rng.standard_normal(23)
        factor = np.tril(rng.standard_normal((23, 23)), -1) + np.diag(rng.random(23) * scale + 1e-30)
        known = read(joint, mean=mean, factor=factor, readings=float(rng.integers(0, 9)), updates=1e3)
        for value, low, high, _ in known.values():
            assert math.isnan(value) or low <= value <= high
        assert repr(known)


def test_curves_agree_with_the_quantities(ordinary):
    drawn = curves(ordinary)
    assert drawn["thrust_left"].value[-1] == pytest.approx(ordinary["thrust_full_left"].value)
    assert drawn["steady_speed"].value[-1] == pytest.approx(ordinary["steady_speed_full"].value)
    middle = len(drawn["drag"].at) // 2
    assert drawn["drag"].value[middle] == pytest.approx(ordinary["drag_half_speed"].value)
    assert (drawn["drag"].high >= drawn["drag"].value).all() and drawn["drag"].low[0] == drawn["drag"].high[0] == 0


def test_online_identifies_with_and_without_torch_and_says_where_it_cannot(tmp_path):
    ensemble = Ensemble({"aid": AID(MASS), "joint_averaged": averaged()})
    online = Online(ensemble)
    sample = log(30, varied(30), varied(30, seed=2))
    for k in range(30):
        inputs = Inputs(*(float(x[k]) for x in sample.inputs))
        online.step(Sample(inputs, float(sample.surge[k]), fresh=True, measured=True))
    path = online.save(tmp_path / "set.safetensors")
    assert Online.open(path).identified().quantities == online.identified().quantities
    batch = Online(averaged(), batch=(2,)).identified()
    assert len(batch) == 2 and batch[0].quantities == batch[1].quantities
    with pytest.raises(ConfigError, match="no joint EKF with estimate_every"):
        Online(Ensemble({"aid": AID(MASS), "joint": JointEKF(TOP)})).identified()
    with pytest.raises(ConfigError, match=r"not inside Robust: add JointEKF\(..., estimate_every=600.0\)"):
        Online(AID(MASS)).identified()


def test_an_ensemble_with_a_member_of_other_code_identifies_too():
    class Slow(Persistence):
        pass

    ensemble = Ensemble({"slow": Slow(), "joint_averaged": averaged()})
    assert ensemble.averaged == "joint_averaged"
    assert "time_constant" in Online(ensemble).identified()


def test_each_boat_has_its_own_mass():
    ensemble = Ensemble({"joint_averaged": averaged(mass=torch.tensor([14.0, 28.0], dtype=torch.float64))})
    boats = identified_boats(ensemble, ensemble.init((2,)), ["a", "b"])
    assert boats["b"]["thrust_full_left"].value == pytest.approx(2 * boats["a"]["thrust_full_left"].value)
