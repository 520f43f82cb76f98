"""Surge, sway and yaw rate side by side, and the tracks that they make."""

import copy
import math
from itertools import pairwise

import numpy as np
import pytest
import torch

import usvlearn
from usvlearn import (
    ARX,
    Ensemble,
    ForecastSettings,
    Inputs,
    JointEKF,
    Online,
    Persistence,
    Planar,
    PlanarSample,
    Sample,
)
from usvlearn.core.samples import rebuild, tree_map
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.errors import CheckpointError, ConfigError, ShapeError
from usvlearn.estimators.planar.state import CONSTANT, ERROR, GROUP, HELD_RATE, RADIUS, RHO, USED
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.planar_fleet import planar_fleet

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long

ALIGN = {"dt": 0.4, "patience": 1.0}
TOP = 2.74  # m/s


def planar(**options) -> Planar:
    members = {"joint": JointEKF(TOP), "arx": ARX(), "persistence": Persistence()}
    return Planar(Ensemble(members, forecasts=ForecastSettings()), surge_max=TOP, **options)


@pytest.fixture(scope="module")
def boats():
    """Two boats, an hour each: samples and poses of each run, (time, boats, …)."""
    fleet = align_fleet(planar_fleet(n=2, hours=1.0, seed=7), **ALIGN)
    return [run.planar for run in fleet.runs]


@pytest.fixture(scope="module")
def learned(boats):
    """The `Planar`, its state at the end, and what became due, (time, boats, horizons, columns)."""
    model = planar()
    with torch.no_grad():
        *_, (state, _) = chunks = list(chunked_rollout(model, model.init((2,)), boats, ["track.due"]))
    return model, state, np.concatenate([record["track.due"] for _, record in chunks])


def element(samples: PlanarSample, boat: int, k: slice | int = slice(None)) -> PlanarSample:
    return tree_map(lambda x: x[k, boat], samples)


def followed(online: Online, samples: PlanarSample) -> Online:
    """After all steps of one boat's samples."""
    for k in range(len(samples.heading)):
        online.step(tree_map(lambda x, k=k: x[k].item(), samples))
    return online


def parameters(online: Online) -> np.ndarray:
    return np.concatenate([online.leaf(f"{axis}.members.{axis}.mean")[2:] for axis in ("yaw", "sway")])


def test_live_is_replay_and_goes_on_from_a_file(boats, tmp_path):
    samples = element(boats[0], 0, slice(300))
    model = planar()
    with torch.no_grad():
        ((state, _),) = chunked_rollout(model, model.init(), [samples], [])
    online = followed(Online(model), element(boats[0], 0, slice(200)))
    online.save(tmp_path / "boat.safetensors")
    online = followed(Online.open(tmp_path / "boat.safetensors"), element(boats[0], 0, slice(200, 300)))
    for name, leaf in arrays_of(state).items():
        assert np.array_equal(leaf, online.state[name], equal_nan=True), name


def test_the_surge_is_that_without_tracks(boats, learned):
    model, state, _ = learned
    with torch.no_grad():
        *_, (alone, _) = chunked_rollout(model.surge, model.surge.init((2,)), [each.sample for each in boats], [])
    for name, leaf in arrays_of(alone).items():
        assert np.array_equal(leaf, arrays_of(state)[f"surge.{name}"], equal_nan=True), name


def test_tracks_are_nearer_than_those_that_learn_nothing_and_ellipses_hold(learned):
    *_, due = learned
    for boat in range(2):
        for k, most in enumerate((0.12, 0.4, 1.0)):
            rows = due[:, boat, k]
            rows = rows[np.isfinite(rows[:, RADIUS])]
            assert len(rows) > 300
            error = rows[:, ERROR].mean()
            assert error < min(most, 0.5 * rows[:, CONSTANT].mean(), 0.5 * rows[:, HELD_RATE].mean())
            inside = rows[:, RHO] <= rows[:, RADIUS]
            assert 0.85 < inside.mean() < 0.95
            for group in range(3):
                if (rows[:, GROUP] == group).sum() > 100:
                    assert 0.8 < inside[rows[:, GROUP] == group].mean() < 0.97


def plain_track(model: Planar, state, commands: np.ndarray, dt: float) -> np.ndarray:
    """A track by the members in torch, step for step as (2) of `estimators.planar.state`; north, east, heading."""
    axes = {name: getattr(model, name) for name in ("surge", "sway", "yaw")}
    members = {name: dict(getattr(state, name).members) for name in axes}
    mean = state.surge.members["joint"].mean
    north, east = mean[2], mean[3]
    w, v, r, _, _, psi = state.track.before
    u, place, elapsed, track = w + north * psi.cos() + east * psi.sin(), torch.zeros(2, dtype=w.dtype), 0.0, []

    def predicted(name: str, inputs: Inputs) -> torch.Tensor:
        forecasts, xs = axes[name].forecasts, []
        for m in forecasts.names:
            members[name][m], x = axes[name].members[m].predict(members[name][m], inputs)
            xs.append(x)
        horizons, weights = forecasts.horizons.tolist(), getattr(state, name).forecasts.rule.weights
        k = max(i for i, h in enumerate(horizons) if i == 0 or h <= elapsed)
        own_weights = weights[k]
        if k + 1 < len(horizons) and elapsed > horizons[k]:
            rise = (elapsed - horizons[k]) / (horizons[k + 1] - horizons[k])
            own_weights = (1 - rise) * weights[k] + rise * weights[k + 1]
        return (own_weights * torch.stack(xs)).sum()

    def ground(u, v, psi):
        aside = v - north * psi.sin() + east * psi.cos()
        return torch.stack([u * psi.cos() - aside * psi.sin(), u * psi.sin() + aside * psi.cos()])

    h = torch.tensor(dt, dtype=w.dtype)
    for left, right in torch.as_tensor(commands):
        elapsed += dt
        ahead = predicted("yaw", Inputs(left, right, v, w, h))
        turned = psi + h * (r + ahead) / 2
        aside = predicted("sway", Inputs(left, right, r, w, h))
        along = predicted("surge", Inputs(left, right, (psi + turned) / 2, (r + ahead) / 2, h))
        place = place + h / 2 * (ground(u, v, psi) + ground(along, aside, turned))
        u, v, r, psi, w = along, aside, ahead, turned, along - north * turned.cos() - east * turned.sin()
        track.append([*place.tolist(), float(psi)])
    return np.array(track)


def test_a_track_is_the_plain_one(boats, learned):
    model, whole, _ = learned
    state = tree_map(lambda x: x[1], whole)
    assert state.sway.members["sway"].updates > USED
    online = Online(model)
    online.state = arrays_of(state)
    online = followed(online, element(boats[0], 1, slice(1)))  # a start changes `before` alone
    rng = np.random.default_rng(0)
    commands = np.clip(np.repeat(rng.uniform(-0.5, 1, (5, 2)), 10, 0), -1, 1)
    now = rebuild(state, {name: torch.as_tensor(leaf) for name, leaf in online.state.items()})
    track = online.forecast(commands, dt=0.4)
    with torch.no_grad():
        expected = plain_track(model, now, commands, 0.4)
    assert np.abs(np.column_stack([track.north, track.east, track.heading]) - expected).max() < 1e-9


def test_covariance_and_ellipse_are_those_of_the_radius(boats, learned):
    online = Online(learned[0])
    online.state = arrays_of(tree_map(lambda x: x[0], learned[1]))
    followed(online, element(boats[0], 0, slice(20)))
    track = online.forecast([[0.5, 0.3]] * 75, dt=0.4)
    major, minor, bearing = track.ellipse()
    assert np.isfinite(major).all() and (major >= minor).all() and (np.diff(major[:25]) > -0.2).all()
    for k in (4, 24, 74):
        C = track.covariance[k]
        direction = np.array([math.cos(bearing[k]), math.sin(bearing[k])])
        assert math.sqrt(-2 * math.log(0.1) * (direction @ C @ direction)) == pytest.approx(major[k], rel=1e-9)
    assert (track.ellipse(0.5)[0] < major).all()
    beyond = online.forecast([[0.5, 0.3]] * 80, dt=0.4)
    assert np.isinf(beyond.covariance[-1, 0, 0]) and np.isfinite(beyond.north).all()


def test_batches_are_forecast_as_single_boats(boats, learned):
    model, state, _ = learned
    plan = torch.rand(20, 2, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    inputs = Inputs(plan[..., 0], plan[..., 1], None, None, torch.full((20, 2), 0.4, dtype=torch.float64))
    track = usvlearn.forecast(model, state, inputs)
    for boat in range(2):
        online = Online(model)
        online.state = arrays_of(tree_map(lambda x, boat=boat: x[boat], state))
        alone = online.forecast(plan[:, boat].numpy())
        for name in ("north", "heading", "covariance"):
            assert np.array_equal(getattr(track, name)[:, boat], getattr(alone, name)), name
    with pytest.raises(ConfigError, match=r"inputs\.heading: found None with Ensemble"):
        usvlearn.forecast(model.surge, state.surge, inputs)
    with pytest.raises(ConfigError, match=r"inputs\.dt: found 40 lengths that differ"):
        usvlearn.forecast(model, state, inputs._replace(dt=inputs.dt * plan[..., 0]))


def test_before_the_first_tracks_nothing_is_known_of_their_errors(boats):
    online = followed(Online(planar()), element(boats[0], 0, slice(10)))
    track = online.forecast([[0.5, 0.5]] * 10)
    assert np.isinf(track.ellipse()[0]).all() and np.isfinite(track.north).all()


BAD = {
    "no heading for 5 s": ("heading", math.nan, 12), "no heading for an hour": ("heading", math.nan, 600),
    "no yaw rate": ("yaw_rate", math.nan, 300),
    "a yaw rate that is none": ("yaw_rate", math.inf, 5), "a sway that is none": ("sway", 1e30, 50),
    "a compass that is off by 20°": ("heading", 0.35, 300), "a jump of 30 m": ("north", 30.0, 600),
    "positions that are none": ("east", -math.inf, 100), "a position on another continent": ("north", 5e6, 10),
    "a number beyond all": ("east", 1e300, 10),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_poses_are_survived(name, boats, learned):
    """All stays finite, no parameter is thrown, and tracks come back to what they were."""
    key, value, steps = BAD[name]
    clean = element(boats[1], 0, slice(700))
    column = getattr(clean, key).copy()
    part = slice(50, 50 + steps)
    column[part] = column[part] + value if name.startswith(("a jump", "a compass")) else value
    ends = []
    for samples in (clean, clean._replace(**{key: column})):
        online = Online(learned[0])
        online.state = arrays_of(tree_map(lambda x: x[0], learned[1]))
        ends.append(followed(online, samples))
    spoilt = ends[1]
    for leaf, values in spoilt.state.items():
        if not leaf.endswith((".due", "predictions", "halfwidths", "slots")):
            assert np.isfinite(values).all() or values.dtype == bool, leaf
    track, other = (each.forecast([[0.5, 0.3]] * 20) for each in (spoilt, ends[0]))
    assert np.isfinite(track.north).all()
    if steps <= 10:
        assert np.allclose(track.ellipse()[0], other.ellipse()[0], rtol=0.5)
    scale = np.concatenate([getattr(learned[0], x).members[x].scale.numpy() for x in ("yaw", "sway")])
    assert np.abs((parameters(spoilt) - parameters(ends[0])) / scale).max() < 0.5


def test_a_lost_thruster_widens_the_ellipses_within_five_seconds(boats, learned):
    model, state, _ = learned
    clean = element(boats[2], 0, slice(400))
    online = Online(model)
    online.state = arrays_of(tree_map(lambda x: x[0], state))
    turning = next(k for k in range(100, 380) if clean.sample.inputs.command_left[k : k + 12].min() > 0.4)
    followed(online, element(boats[2], 0, slice(turning)))
    before = online.forecast([[0.5, 0.5]] * 25).ellipse()[0]
    for k in range(turning, turning + 12):  # 4.8 s in which the left thruster gives next to nothing
        one = tree_map(lambda x, k=k: x[k].item(), clean)
        drift = 0.15 * min(k - turning + 1, 4)  # rad/s to port, as of a boat that is pushed by its right side alone
        online.step(one._replace(yaw_rate=one.yaw_rate - drift))
    after = online.forecast([[0.5, 0.5]] * 25).ellipse()[0]
    assert (after[[4, 12, 24]] > 1.3 * before[[4, 12, 24]]).all()


@pytest.mark.thorough
def test_numbers_of_single_precision_stay_finite_for_long(boats):
    model = planar().to(torch.float32)
    parts = [tree_map(lambda x: x if x.dtype == bool else x.astype(np.float32), each) for each in boats]
    with torch.no_grad():
        *_, (state, recorded) = chunked_rollout(model, model.init((2,)), parts, ["track.due"])
    assert all(torch.isfinite(x).all() for x in (state.yaw.members["yaw"].mean, state.track.covariance))
    errors = recorded["track.due"][:, :, 0, ERROR]
    assert np.nanmean(errors) < 0.2


@pytest.mark.slow
def test_a_million_steps_of_single_precision(boats):
    model = planar().to(torch.float32)
    one = tree_map(lambda x: x[:, :1] if x.dtype == bool else x[:, :1].astype(np.float32), boats[0])
    state, rounds = model.init((1,)), -(-1_000_000 // len(one.heading))
    with torch.no_grad():
        for after, recorded in chunked_rollout(model, state, [one] * rounds, ["track.due"]):
            assert all(torch.isfinite(x).all() for x in (after.yaw.members["yaw"].mean, after.track.covariance))
            errors = recorded["track.due"][:, :, 0, ERROR]
            assert np.nanmean(errors) < 0.5


def test_what_is_wrong_is_told(boats, tmp_path):
    with pytest.raises(ConfigError, match=r"surge: found an ensemble without compiled code or forecasts"):
        Planar(Ensemble({"joint": JointEKF(TOP)})).description()
    with pytest.raises(ConfigError, match=r"surge: found the members persistence, expected a filter of the kind joint"):
        Planar(Ensemble({"persistence": Persistence()}, forecasts=ForecastSettings())).description()
    with pytest.raises(ConfigError, match=r"horizons: found \[5, 2\], expected times, s, increasing"):
        planar(horizons=[5, 2])
    with pytest.raises(ConfigError, match=r"headings: found none, and JointEKF"):
        Online(JointEKF(TOP)).forecast([[0.5, 0.5]])
    online = Online(planar())
    with pytest.raises(ConfigError, match=r"commands: found 2 for the left side in step 1"):
        online.forecast([[2.0, 0.5]])
    one = Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True)
    with pytest.raises(TypeError, match=r"heading: found 'north', expected a number"):
        online.step(PlanarSample(one, "north", 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ShapeError, match=r"sway: found the shape \(2,\), expected one number"):
        online.step(PlanarSample(one, 0.0, 0.0, [0.0, 1.0], 0.0, 0.0))
    online.save(tmp_path / "boat.safetensors")
    leaves, facts = dict(online.state), {"estimator": "Planar", "kernel": dict(online.description)}
    from usvlearn.engine.validate import check

    check(facts["kernel"], leaves)
    for key, value, words in (
        ("vectors", {"horizons": [5.0, 2.0]}, r"kernel\.vectors\.horizons"),
        ("numbers", {"coverage": 0.9, "overlap": 1e9}, r"kernel\.numbers\.overlap"),
        ("yaw", facts["kernel"]["surge"], r"kernel\.yaw: found no forecasts, or no filter"),
        ("sway", {"kind": "persistence", "size": 0, "numbers": {}}, r"kernel\.sway\.kind"),
    ):
        with pytest.raises(CheckpointError, match=words):
            check(facts["kernel"] | {key: value}, leaves)
    with pytest.raises(CheckpointError, match=r"state\.track"):
        check(facts["kernel"], {name: leaf for name, leaf in leaves.items() if name != "track.slots"})


def test_a_copy_learns_sway_and_yaw_rate_too(boats):
    online = copy.deepcopy(Online(planar()))
    for k in range(30):
        online.step(tree_map(lambda x, k=k: x[k].item(), element(boats[0], 0)))
    assert online.leaf("yaw.members.yaw.updates") > 0


def test_a_sample_alone_measures_nothing_else(boats):
    online = Online(planar())
    for one, other in pairwise(range(30)):
        assert one < other
        online.step(tree_map(lambda x, k=other: x[k].item(), element(boats[0], 0).sample))
    assert online.leaf("yaw.members.yaw.updates") == 0 and np.isfinite(online.forecast([[0.5, 0.5]] * 5).north).all()
