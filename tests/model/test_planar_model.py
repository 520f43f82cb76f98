"""The planar model: its axes are those of the filters, its step is that of a track and of the equations."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.support.planar_models import commanded, drawn_planar, learned, lone_filters, mean_of, moving
from tests.support.surge_models import by_filter
from usvlearn import Inputs, Online, SwayEKF, YawEKF
from usvlearn.errors import ConfigError
from usvlearn.estimators.augmented_ekf.state import Y
from usvlearn.estimators.joint.state import THETA
from usvlearn.model.planar import COEFFICIENTS, UNITS, Motion, PlanarModel
from usvlearn.model.surge import WITHOUT_EVEN, SurgeModel

STILL = Motion(*[0.0] * 6)


def by_filters(model: PlanarModel, kind: str, y, other, surge, left, right, dt) -> np.ndarray:
    """y⁺ of the axis EKF."""
    given = [torch.tensor(x) for x in (left, right, other, surge, dt)]
    axis, mean = {"yaw": YawEKF, "sway": SwayEKF}[kind](2.7), np.tile(mean_of(model, kind), (len(dt), 1))
    mean[:, Y] = y
    state = axis.init((len(dt),))._replace(mean=torch.from_numpy(mean), commands=torch.stack(given[:2], -1))
    return axis.predict(state, Inputs(*given))[1].numpy()


@pytest.mark.parametrize("sways", [True, False])
def test_a_step_is_that_of_the_filters(sways):
    rng = np.random.default_rng(1)
    model, (left, right, dt, north, east) = drawn_planar(rng, sways), commanded(rng, 300)
    before = moving(rng, 300)
    u, v, r, psi = before[:4]
    v = v if sways else 0 * v
    moved = model.step(before, left, right, dt, (north, east))
    turned = by_filters(model, "yaw", r, v, u, left, right, dt)
    aside = by_filters(model, "sway", v, r, u, left, right, dt) if sways else 0 * v
    along = by_filter(model.surge, torch.tensor(np.stack([u, left, right, (r + turned) / 2, dt], -1))).detach().numpy()
    after = psi + dt * (r + turned) / 2
    velocity = np.exp(1j * psi) * (u + 1j * v) + np.exp(1j * after) * (along + 1j * aside)  # north + i east
    place = before.north + 1j * before.east + dt * (north + 1j * east) + dt / 2 * velocity
    inside = np.abs(along) < 20  # the filter limits its speed there
    assert inside.mean() > 0.9
    for name, expected in zip(Motion._fields, (along, aside, turned, after, place.real, place.imag), strict=True):
        np.testing.assert_allclose(getattr(moved, name)[inside], expected[inside], 1e-12, 1e-12, err_msg=name)


def gentle() -> SurgeModel:
    zero = dict.fromkeys(WITHOUT_EVEN, 0.0)
    return SurgeModel(30.0, zero | {"drag_linear": -15.0, "drag_cross": -4.0, "drag_quadratic": -3.0,
                                    "thrust_linear_left": 20.0, "thrust_quadratic_right": 22.0})  # fmt: skip


def test_short_steps_solve_the_differential_equations():
    """By another solver, from the equations as they are written; each axis sees the others as they were, so the step is
    of first order.
    """
    model = drawn_planar(np.random.default_rng(2), surge=gentle())
    left, right, current, a, b = 0.8, -0.3, (0.2, -0.1), model.yaw, model.sway

    def rates(_, x):
        u, v, r, psi, *_ = x
        yaw = a["bias"] + a["linear"] * r + a["quadratic"] * r * abs(r) + a["cross"] * abs(u) * r
        yaw += a["coupling"] * u * v + a["other"] * v + a["surge"] * u
        sway = b["bias"] + b["linear"] * v + b["quadratic"] * v * abs(v) + b["cross"] * abs(u) * v
        sway += b["coupling"] * u * r + b["other"] * r + b["surge"] * u
        for side, xi in (("left", left), ("right", right)):
            yaw += a[f"linear_{side}"] * xi + a[f"quadratic_{side}"] * xi * abs(xi) + a[f"cubic_{side}"] * xi**3
            yaw += a[f"speed_{side}"] * xi * abs(u)
            yaw += a[f"even_linear_{side}"] * abs(xi) + a[f"even_quadratic_{side}"] * xi**2
            sway += b[f"linear_{side}"] * xi + b[f"quadratic_{side}"] * xi * abs(xi)
        along = (-3 * u * abs(u) - 15 * u - 4 * abs(r) * u + 20 * left + 22 * right * abs(right)) / 30
        cosine, sine = np.cos(psi), np.sin(psi)
        return along, sway, yaw, r, u * cosine - v * sine + current[0], u * sine + v * cosine + current[1]

    start, end = Motion(1.0, 0.2, -0.3, 0.5, 3.0, -2.0), 6.0
    exact = solve_ivp(rates, (0, end), start, rtol=1e-11, atol=1e-11).y[:, -1]
    errors = []
    for count in (150, 300):
        ahead = model.simulate(start, left, right, np.full(count, end / count), current)
        errors.append(np.abs(np.array([each[-1] for each in ahead]) - exact).max())
    assert errors[0] < 2e-3 and 1.8 < errors[0] / errors[1] < 2.3, errors


def test_a_simulation_is_a_chain_of_steps_of_one_boat_or_of_several():
    rng = np.random.default_rng(3)
    model, given, motion = drawn_planar(rng), commanded(rng, 20), moving(rng, 4)
    motions = model.simulate(motion, *given[:3, :, None], given[3:, :, None])
    for k, (left, right, dt, *current) in enumerate(given.T):
        motion = model.step(motion, left, right, dt, tuple(current))
        np.testing.assert_array_equal([each[k] for each in motions], motion)
    assert motions.surge.shape == (20, 4)


def test_a_track_of_lone_filters_is_the_simulation_of_their_model():
    """(2) of `usvlearn.estimators.planar.state`, without current; no lag, and the filters know their components."""
    rng = np.random.default_rng(4)
    model, (left, right, *_) = drawn_planar(rng, surge=gentle()), commanded(rng, 25)
    start = moving(rng)._replace(north=0.0, east=0.0)
    online, w, v, r = Online(lone_filters()), *start[:3]
    leaves = learned(model)
    leaves["yaw.members.yaw.mean"][0], leaves["sway.members.sway.mean"][0] = r, v
    joint = np.zeros_like(online.leaf("surge.members.joint.mean"))
    joint[0], joint[THETA : THETA + len(WITHOUT_EVEN)] = w, model.surge.per_mass[:-1]
    leaves["surge.members.joint.mean"] = joint
    leaves["track.before"] = np.array([w, v, r, left[0], right[0], start.heading])
    online._live.leaves = {**online._live.leaves, **leaves}
    track = online.forecast(np.stack([left, right], -1), dt=0.4)
    expected = model.simulate(start, left, right, 0.4)
    for name in Motion._fields:
        np.testing.assert_allclose(getattr(track, name), getattr(expected, name), 1e-12, 1e-12, err_msg=name)


def test_more_command_on_the_left_turns_to_starboard_and_the_current_carries():
    yaw = {**dict.fromkeys(COEFFICIENTS["yaw"], 0.0), "linear": -1.0, "linear_left": 0.3, "linear_right": -0.3}
    sailed = PlanarModel(gentle(), yaw).simulate(STILL, 0.8, 0.6, np.full(20, 0.2))
    assert sailed.yaw_rate[-1] > 0 and sailed.heading[-1] > 0 and sailed.north[-1] > 0 and sailed.east[-1] > 0
    carried = PlanarModel(gentle(), yaw).simulate(STILL, 0.8, 0.6, np.full(20, 0.2), (0.0, -0.5))
    np.testing.assert_allclose(carried.east, sailed.east - 0.1 * np.arange(1, 21), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(carried.north, sailed.north)


def test_every_coefficient_has_a_unit():
    assert {kind: tuple(each) for kind, each in UNITS.items()} == COEFFICIENTS


@pytest.mark.parametrize(
    ("yaw", "sway", "words"),
    [
        (np.zeros(21), None, r"yaw: found a mean of the shape \(21,\), expected \(22,\)"),
        (np.zeros((2, 22)), None, r"yaw: found a mean of the shape \(2, 22\)"),
        (np.full(22, np.nan), None, "yaw.bias: found nan, expected a finite number"),
        (np.zeros(22), np.full(14, np.inf), "sway.bias: found inf"),
    ],
)
def test_what_is_no_boat_is_refused(yaw, sway, words):
    with pytest.raises(ConfigError, match=words):
        PlanarModel.of(gentle(), yaw, sway)


def test_missing_and_unknown_coefficients_are_named():
    with pytest.raises(ConfigError, match="yaw: found the coefficients drag, expected bias, linear"):
        PlanarModel(gentle(), {"drag": 1.0})
