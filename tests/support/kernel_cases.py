"""What the compiled kernels are held against torch on: estimators far from their defaults, and samples with faults."""

import math

import numpy as np
import torch

from usvlearn import (
    AID,
    ARX,
    BOA,
    RLS,
    RNN,
    Average,
    Ensemble,
    Estimator,
    ExponentialWeights,
    FixedWeights,
    ForecastSettings,
    Inputs,
    JointEKF,
    Persistence,
    QuasiStatic,
    RecursiveWeights,
    Robust,
    Sample,
    SIFtRLS,
    SurgeDynamics,
    Trial,
    YawEKF,
)
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.backend import arrays_of, tree_of
from usvlearn.engine.dispatch_tables import inflate_covariance
from usvlearn.engine.program import program_for

PRIOR = [-3.0, -6.0, -4.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0]
STIFF = [-9e3, -9e3, 0, 500, 500, -200, 500, 500, -200]  # dt Ĵ far below −20
ALL = {"cubic": True, "exponential": True}
CONDITIONS = ("simple", "gershgorin", "lmi", "exact", "interval")


def mission(steps: int, *batch: int, seed: int = 0, faults: bool = True, dtype=torch.float64) -> Sample:
    """A boat under steps of command, with noise; with missing, stale, absurd and outlying samples, and new segments."""
    rng = np.random.default_rng(seed)
    shape, held = (steps, *batch), (steps // 12 + 1, *batch)
    left, right = (np.repeat(rng.uniform(-0.3, 1, held), 12, 0)[:steps] for _ in range(2))
    dt = np.where(rng.random(shape) < 0.9, 0.4, rng.uniform(0.05, 2.0, shape))
    yaw_rate = 0.3 * (left - right) + 0.02 * rng.standard_normal(shape)
    heading = np.cumsum(yaw_rate * dt, 0)
    surge, v = np.empty(shape), np.zeros(batch)
    for k in range(steps):
        force = 18 * (left[k] + right[k]) + 15 * (left[k] * abs(left[k]) + right[k] * abs(right[k]))
        v = v + np.minimum(dt[k], 0.5) / 28 * (force - 6 * v * abs(v) - 8 * v + 2 * np.cos(heading[k]))
        surge[k] = v
    surge += 0.02 * rng.standard_normal(shape)
    fresh, measured = np.ones(shape, bool), np.ones(shape, bool)
    if faults:
        chance = rng.random(shape)
        places = iter(np.arange(0, 0.12, 0.01))

        def some() -> np.ndarray:
            begin = next(places)
            return (chance >= begin) & (chance < begin + 0.01)

        surge[some()] += 5.0
        surge[some()] = -99.0
        surge[some()] = 1e6
        surge[some()] = math.nan
        left[some()] = math.nan
        right[some()] = 1.5
        yaw_rate[some()] = -math.inf
        heading[some()] = 1e5
        dt[some()] = 0.0  # a segment starts
        dt[some()] = 60.0
        measured[some()] = False
        fresh[some()] = False
        for begin in range(150, steps, 400):  # an outage, a standstill, a change
            measured[begin : begin + 20] = False
            left[begin + 60 : begin + 90] = right[begin + 60 : begin + 90] = surge[begin + 60 : begin + 90] = 0.0
            surge[begin + 120 : begin + 150] += 1.0
        measured &= fresh
    arrays = Inputs(left, right, heading, yaw_rate, dt), surge, fresh, measured
    return tree_map(lambda x: torch.as_tensor(x, dtype=None if x.dtype == bool else dtype), Sample(*arrays))


def failing_thrusters() -> Sample:
    """A boat at a steady speed whose left thruster fails, recovers, and then pushes backwards."""
    rng = np.random.default_rng(0)
    left, right = (np.repeat(rng.uniform(-1, 1, 500), 5) for _ in range(2))
    effect, yaw_rate = np.ones(2500), np.zeros(2500)
    effect[1200:1400], effect[1900:2100] = 0.1, -2.0
    for k in range(1, 2500):
        yaw_rate[k] = 0.5 * yaw_rate[k - 1] + 0.5 * (effect[k] * left[k] - right[k]) + 0.02 * rng.standard_normal()
    inputs = Inputs(*map(torch.from_numpy, (left, right, np.zeros(2500), yaw_rate, np.full(2500, 0.4))))
    yes = torch.ones(2500, dtype=torch.bool)
    return Sample(inputs, torch.ones(2500, dtype=torch.float64), yes, yes)


def difference(found, expected) -> float:
    """The largest difference of two trees, each leaf's relative to its largest entry; infinite where NaN or inf differ.

    >>> difference({"a": torch.tensor([1.0, 4.0])}, {"a": torch.tensor([1.0, 5.0])})
    0.2
    """
    found, expected, worst = dict(named_leaves(found)), dict(named_leaves(expected)), 0.0
    assert found.keys() == expected.keys()
    for name, leaf in expected.items():
        assert found[name].shape == leaf.shape and found[name].dtype == leaf.dtype, name
        x, y = found[name].double().numpy(), leaf.detach().double().numpy()
        known = np.isfinite(y)
        if not np.array_equal(x[~known], y[~known], equal_nan=True) or not np.isfinite(x[known]).all():
            return math.inf
        error, largest = (np.abs(z).max(initial=0.0) for z in (x[known] - y[known], y[known]))
        worst = max(worst, float(error / largest) if largest > 0 else (math.inf if error > 0 else 0.0))
    return worst


def inflated(estimator: Estimator, state, factor: float):
    """The state whose covariance `Robust` inflates where it accepts a change, of one boat."""
    plan = program_for(estimator.description(), (), np.dtype(np.float64))
    states = plan.pack(arrays_of(state))
    inflate_covariance(plan.program[1], states[0], plan.numbers[0], factor)
    return tree_of(state, plan.unpack(states))


def _three() -> dict:
    return {"aid": AID(28.0), "rls": RLS(), "rnn": RNN(6)}


def _clipped() -> Robust:
    return Robust(SIFtRLS(SurgeDynamics(28.0), memory=20.0), threshold=2.0, patience=1, inflation=2.0)


def _crew() -> dict:
    return {"aid": AID(28.0), "long": _clipped(), "rnn": RNN(6, unroll=2), "persistence": Persistence()}


def _boxed(**options) -> RNN:
    """A network of which some neurons are always on in the box of `interval`, and some never."""
    rnn = RNN(9, condition="interval", rate=0.02, contraction_rate=0.5, initial="random", **options)
    rnn.b.data += torch.linspace(-6.0, 6.0, 9, dtype=torch.float64)
    rnn.a.data *= 3.0
    return rnn


VARIANTS = {
    "aid_dead_zone": lambda: AID(28.0, dead_zone=0.05, gain=4.0, floor=0.02),
    "aid_prior": lambda: AID(28.0, theta0=PRIOR, spread=[5, 0, 2, 9, 9, 1, 9, 9, 1], project=False),
    "aid_leaks": lambda: AID(28.0, sigma=5.0, bound=0.3, theta0=PRIOR),
    "aid_never_leaks": lambda: AID(28.0, sigma=0.0, gain=30.0),
    "aid_estimate_leaks": lambda: AID(28.0, feedback="estimate", leak=0.3, bound=0.5, surge_max=2.0),
    "aid_quasi_static": lambda: AID(model=QuasiStatic(), gain=0.5),
    "aid_all_terms": lambda: AID(model=SurgeDynamics(28.0, **ALL), feedback="estimate"),
    "aid_stiff": lambda: AID(28.0, theta0=STIFF, model=SurgeDynamics(28.0, exponential=True)),
    "rls_all_terms": lambda: RLS(SurgeDynamics(28.0, **ALL), forgetting=0.97, covariance=0.1),
    "rls_exponential": lambda: RLS(SurgeDynamics(28.0, exponential=True), forgetting=0.95),
    "sift_cubic": lambda: SIFtRLS(SurgeDynamics(28.0, cubic=True), memory=5.0),
    "rls_surge_max": lambda: RLS(SurgeDynamics(28.0), forgetting=0.9, surge_max=1.2),
    "rls_trace": lambda: RLS(SurgeDynamics(28.0), forgetting=0.8, trace_growth=1e-3, feedback="estimate"),
    "sift_floor": lambda: SIFtRLS(SurgeDynamics(28.0), memory=2.0, floor=0.3, surge_max=1.5),
    "sift_no_floor": lambda: SIFtRLS(memory=0.5, floor=0.0, covariance=100.0),
    "sift_long": lambda: SIFtRLS(SurgeDynamics(5.0), memory=1e4, feedback="estimate"),
    "robust_sift": lambda: Robust(SIFtRLS(SurgeDynamics(28.0)), threshold=0.5, patience=1, inflation=200.0),
    "robust_rls": lambda: Robust(RLS(forgetting=0.97), threshold=1.0, patience=3, scale=0.01, memory=5.0),
    "robust_loose": lambda: Robust(
        RLS(SurgeDynamics(28.0), forgetting=0.7, trace_growth=1e5), threshold=1.0, patience=1, inflation=1e4
    ),
    "robust_rnn": lambda: Robust(RNN(6, rate=5e-3), threshold=1.0, patience=1, scale_min=0.05),
    "robust_rnn_blows_up": lambda: Robust(RNN(6, rate=1e200, stability="none", clip=None), threshold=100.0),
    "robust_rnn_refuses": lambda: Robust(RNN(6, rate=1e308, stability="none"), threshold=100.0),
    "robust_persistence": lambda: Robust(Persistence(), threshold=1.0, patience=1, memory=20.0),
    "arx_no_lags": lambda: ARX(lags=0, even=False, thrust_speed=True, surge_max=1.0),
    "arx_long": lambda: ARX(lags=8, turning=True, scale=3.0, walk=0.1, degrees=1.0),
    "robust_arx": lambda: Robust(ARX(lags=1), threshold=1.0, patience=1, inflation=200.0),
    **{
        f"rnn_{condition}_{gauge}_{unroll}": lambda c=condition, g=gauge, u=unroll: RNN(
            7, condition=c, gauge=g, unroll=u, rate=0.02, contraction_rate=0.9, seed=3, initial="random"
        )
        for condition in CONDITIONS
        for gauge in ("literal", "best")
        for unroll in (1, 2)
    },
    "rnn_paper": lambda: RNN(
        20, 3.0, "random", None, 5e-4, (1, 1, 1, 1, 1), momentum=0.9, clip=None, stability="penalty", penalty=0.1,
        unroll=2,
    ),
    **{
        f"rnn_{condition}_regauged": lambda c=condition: RNN(7, condition=c, rate=0.2, initial="random")
        for condition in ("simple", "gershgorin")
    },
    "rnn_clips": lambda: RNN(6, rate=1e20, stability="none"),
    "rnn_free": lambda: RNN(3, stability="none", decay=50, clip=1e-3, momentum=0.5),
    "rnn_box": _boxed,
    "rnn_box_2": lambda: _boxed(unroll=2, clip=None, seed=2),
    "rnn_interval_fast": lambda: RNN(20, condition="interval", rate=0.05, clip=None, contraction_rate=0.5),
    "rnn_replay_one": lambda: RNN(6, replay_size=1, replay_steps=1, rate=0.02),
    "rnn_replay_estimate": lambda: RNN(
        6, condition="interval", feedback="estimate", unroll=2, clip=None, replay_size=40, replay_steps=5
    ),
    "rnn_replay_penalty": lambda: RNN(
        6, stability="penalty", penalty=0.01, momentum=0.9, replay_size=20, replay_steps=30
    ),
    "robust_rnn_replay": lambda: Robust(RNN(6, unroll=2, replay_size=30), threshold=1.0, patience=1),
    "rnn_estimate_lmi": lambda: RNN(9, condition="lmi", feedback="estimate", rate=0.02, decay=None, surge_max=0.5),
    "all_average": lambda: Ensemble(_crew(), watched=False, coverage=0.5),
    "all_fixed": lambda: Ensemble(_crew(), {"fixed": FixedWeights({"aid": -0.5, "long": 1.2, "rnn": 0.3})}),
    "recursive": lambda: Ensemble(
        _crew(), {"all": RecursiveWeights(forgetting=0.9, trace_max=2.0, surge_max=1.0),
                  "some": RecursiveWeights(["rnn", "long"], covariance=1e-3)}, output="all",
    ),
    "every_rule": lambda: Ensemble(
        _crew(),
        {
            "average": Average("rnn"), "fixed": FixedWeights({"rnn": 0.0, "aid": 0.0}),
            "exponential": ExponentialWeights(rate=3.0, memory=5.0, loss="square", prior={"aid": 3.0}),
            "exponential_all": ExponentialWeights(["aid", "rnn"], memory=None, rate=0.1),
            "boa": BOA(memory=None, share=0.0), "boa_square": BOA(["long", "rnn"], 3.0, "square", 0.1, 0.2),
            "one": BOA(["rnn"]), "weighted": RecursiveWeights(),
        },
        output="boa_square", coverage=0.99,
    ),
    "sleepers": lambda: Ensemble(
        _three() | {"still": Persistence(), "sift": SIFtRLS(SurgeDynamics(28.0))},
        {"average": Average(["aid", "rls"]), "fixed": FixedWeights({"rls": 0.5, "rnn": 0.0}), "we": RecursiveWeights(),
         "alone": RecursiveWeights(["aid"]),
         "exponential": ExponentialWeights(), "boa": BOA(), "square": BOA(loss="square", prior={"rnn": 9.0})},
        surge_max=1.0, output="we",
    ),
    "robust_members": lambda: Ensemble(
        {"a": Robust(RNN(6), threshold=1.0), "b": Robust(AID(28.0), threshold=1.0), "c": Persistence()},
        {"boa": BOA(memory=1.0)},
    ),
    "forecasts": lambda: Ensemble(
        _three() | {"joint": JointEKF(2.0, 28.0), "arx": ARX(), "still": Persistence(), "long": _clipped()},
        {"average": Average(), "boa": BOA(["joint", "still"])},
        forecasts=ForecastSettings((0.4, 1.2, 4.0), ["joint", "rnn", "arx", "still"], memory=3.0, share=0.1),
    ),
    "forecasts_trial": lambda: Ensemble(
        {"joint": JointEKF(2.0, 28.0, trial=Trial(threshold=4.0, leads=1.0, steps=9)), "still": Persistence()},
        forecasts=ForecastSettings((0.4, 1.2), overlap=2.0),
    ),
    "forecasts_wrapped": lambda: Ensemble(
        {
            "robust": Robust(RLS(SurgeDynamics(28.0, **ALL)), threshold=1.0), "aid": AID(28.0), "still": Persistence(),
            "sift": SIFtRLS(SurgeDynamics(28.0)), "wild": RNN(6, rate=5.0, stability="none", clip=None),
        },
        surge_max=1.2, forecasts=ForecastSettings((2.0,), overlap=2.5),
    ),
}  # fmt: skip

_some = torch.tensor([0.3, 1.0, 2.0, 5.0], dtype=torch.float64)
LONG = {  # one of every family; four batch elements, which are settings where hyperparameters broadcast
    "aid": lambda: AID(28.0 * _some, gain=_some, bound=1.5, dead_zone=0.01),
    "aid_estimate": lambda: AID(28.0, gain=_some, feedback="estimate", leak=_some),
    "rls": lambda: RLS(SurgeDynamics(28.0 * _some), forgetting=1 - 0.01 * _some, covariance=_some),
    "sift": lambda: SIFtRLS(SurgeDynamics(28.0), memory=5 * _some, covariance=_some),
    "robust": lambda: Robust(
        SIFtRLS(SurgeDynamics(28.0, **ALL), memory=5 * _some), 2.0, 1, inflation=1 + _some, scale=_some
    ),
    "rnn": lambda: RNN(6, rate=1e-3 * _some, contraction_rate=1 - 0.1 * _some),
    "rnn_interval": lambda: RNN(6, condition="interval", gauge="best", rate=1e-3 * _some, unroll=2),
    "rnn_penalty": lambda: RNN(6, stability="penalty", penalty=1e-3 * _some, momentum=0.9),
    "rnn_replay": lambda: RNN(6, rate=1e-3 * _some, unroll=2, replay_size=300, replay_steps=4),
    "rnn_replay_penalty": lambda: RNN(6, stability="penalty", penalty=1e-3 * _some, replay_size=50),
    "joint": lambda: JointEKF(
        1 + _some, 28.0 * _some, disturbance=_some, even=0.1 * _some, outlier=3 + _some, estimate_every=60.0
    ),
    "yaw": lambda: YawEKF(1 + _some, turn_max=_some, disturbance=_some, drift_time=100 * _some, outlier=3 + _some),
    "arx": lambda: ARX(scale=0.3 * _some, walk=1e-4 * _some, degrees=5 * _some),
    "pair": lambda: Ensemble(
        {"aid": AID(28.0, gain=3.0), "still": Robust(Persistence(), scale=_some)},
        {"we": RecursiveWeights(), "boa": BOA()},
    ),
    "forecasts": lambda: Ensemble(
        {"joint": JointEKF(1 + _some, 28.0 * _some), "aid": AID(28.0 * _some), "persistence": Persistence()},
        {"boa": BOA()}, forecasts=ForecastSettings((0.4, 2.0, 5.2), overlap=3),
    ),
    "ensemble": lambda: Ensemble(
        {"rls": RLS(forgetting=1 - 0.01 * _some), "long": _clipped(), "rnn": RNN(6), "persistence": Persistence()},
        {"average": Average(), "we": RecursiveWeights(), "ewa": ExponentialWeights(rate=5 * _some), "boa": BOA()},
    ),
}  # fmt: skip
