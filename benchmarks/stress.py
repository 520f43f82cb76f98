"""Robustness of the estimators to bad samples, beside padasip, river, filterpy and kalman-py.

python benchmarks/stress.py [--steps 1000000] [--boats 5]        writes docs/benchmarks/stress.md

One boat, m·surge_dot = Wᵀθ, is simulated with known θ, 0.4 s a step: thruster commands that change every 4 s, noise of
0.02 m/s on the measured speed. All see the same samples, one step ahead, and predict before they learn: the regressor
is φ = dt·W/m, the target the increment of the measured speed. Peers get samples as they come, as their documentation
shows; without a speed they coast on their own prediction and learn nothing.

Memory: all least squares forget over 200 steps (λ = 0.995). For SIFt-RLS that is 1 − λ per direction, times nine: the
mean loss of information is the same. For the Kalman filter, whose parameters walk at random, it is the Q by which a
prediction has the same variance. All start from P = 10 in units of the noise's variance. `plain_rls` is the textbook's
P ← (P − K φᵀP)/λ. The rates of `padasip_nlms` and `river_linear` are the best of 0.01, 0.03, 0.1, 0.3 and 1 on another
seed. `robust_huber` has the threshold 1.345 instead of 4. `joint_ekf` and `arx` have their defaults, and no wrapper.
`joint_quick`, which follows the boat within seconds, and `ensemble` have the settings of `configs/`; the ensemble is
BOA over two joint EKFs, ARX and the averaged joint EKF.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from pages import machine, publish, table
from peers import LAM, NOISE, P, Peer, peers
from torch import Tensor

from usvlearn import AID, ARX, RLS, Ensemble, JointEKF, Persistence, Robust, SIFtRLS
from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.regressors.layer import SurgeDynamics

DT, OUTLIERS = 0.4, 0.02  # s, share
TRUTH = np.array([-3.0, -6.0, -4.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0]) / 28  # θ/m
SIFT_MEMORY = -DT / math.log(1 - P * (1 - LAM))  # s
WINDOW, WITHIN = 240, 1.5  # samples of the running error, of all elements; times its level before: it is back
MODEL = SurgeDynamics(1.0)
SURGE_MAX = 3.3  # m/s, the boat's top speed
SEED, GUSTY = 71, 60.0  # of the boats that change; h of each plant in gusts


class Scenario(NamedTuple):
    """What happens to the boat, and over which steps the predictions are judged."""

    title: str
    samples: Sample  # (time, elements)
    target: Tensor  # (time, elements) m/s, what would have been measured, had nothing gone wrong
    theta: Tensor  # (elements, p) in force at the end
    lead: int  # steps of excitation with which it begins
    after: slice  # steps of the error after
    event: int | None = None  # step from which recovery counts; None: there is none


class Result(NamedTuple):
    """How an estimator came through."""

    error: float  # m/s, MAE one step ahead over `after`
    steps: float | None  # after the event, until the running error stays within WITHIN times its level before
    finite: bool  # all predictions, and the state at the end


def drive(
    parts: list[tuple[str, int]], elements: int, seed: int, factors: np.ndarray | float = 1.0, changes: int = 0
) -> Scenario:
    """The boat through parts of "excited", "idle" and "cruise"; θ is `factors` times TRUTH from step `changes` on."""
    rng = np.random.default_rng(seed)
    kinds = np.concatenate([np.full(n, kind) for kind, n in parts])[:, None]
    n = len(kinds)
    random = rng.random((2, math.ceil(n / 10), elements)).repeat(10, 1)[:, :n]
    left, right = np.where(kinds == "excited", random, np.where(kinds == "cruise", 0.6, 0.0))
    heading = (0.05 * rng.standard_normal((n, elements)) * (kinds == "excited")).cumsum(0)
    yaw_rate = np.diff(heading, axis=0, prepend=heading[:1]) / DT
    changed, v, surge = np.broadcast_to(TRUTH * factors, (elements, P)), np.zeros(elements), np.empty((n, elements))
    for k in range(n):
        cq, cl, cr, aL, bL, gL, aR, bR, gR = (TRUTH[None] if k < changes else changed).T
        drag = cq * abs(v) * v + cl * v + cr * abs(yaw_rate[k]) * v
        left_thrust = (aL + bL * left[k] + gL * abs(v)) * left[k]
        v = v + DT * (drag + left_thrust + (aR + bR * right[k] + gR * abs(v)) * right[k])
        surge[k] = v
    target = torch.from_numpy(surge + NOISE * rng.standard_normal((n, elements)))
    yes = torch.ones_like(target, dtype=torch.bool)
    inputs = Inputs(*map(torch.from_numpy, (left, right, heading, yaw_rate, np.full_like(left, DT))))
    return Scenario("", Sample(inputs, target, yes, yes), target, torch.tensor(changed), parts[0][1], slice(None))


def scenarios(steps: int = 1_000_000, elements: int = 24) -> dict[str, Scenario]:
    """All of them by name; `steps` limits every part."""
    rng = np.random.default_rng(0)
    lead, ten_minutes, outage, cycle = (min(n, steps) for n in (2000, 1500, 3000, 25_000))
    twice, half = [("excited", lead)] * 2, slice(lead, None)
    cases = {}
    for seed, (name, long) in enumerate({"idle": 100_000, "cruise": 9_000}.items()):
        n = min(long, steps)
        quiet = drive([("excited", lead), (name, n), ("excited", lead)], 4, seed)
        title = f"{n} steps of {name}, then excitation: first 50 predictions"
        cases[name] = quiet._replace(title=title, after=slice(lead + n, lead + n + 50), event=lead + n)

    parts = [("idle", cycle * 2 // 5), ("cruise", cycle * 2 // 5), ("excited", cycle // 5)] * (steps // cycle)
    mixed = drive([("excited", lead), *parts], 1, 2)
    title = f"{len(mixed.target)} steps of idle, cruise and excitation in turn: last {cycle // 5}"
    cases["mixed"] = mixed._replace(title=title, after=slice(-(cycle // 5), None))

    wild = drive(twice, elements, 3)
    off = 2 * rng.standard_t(3, wild.target.shape) * (rng.random(wild.target.shape) < OUTLIERS)
    title = f"{OUTLIERS:.0%} of the speeds off by 2 m/s times Student's t of 3 degrees: second half"
    samples = wild.samples._replace(surge=wild.target + torch.from_numpy(off))
    cases["outliers"] = wild._replace(title=title, samples=samples, after=half)

    spoilt = drive(twice, elements, 4)
    inputs, surge = tree_map(torch.clone, spoilt.samples.inputs), spoilt.target.clone()
    surge[lead], inputs.command_left[lead + 20], inputs.command_right[lead + 40] = math.nan, math.nan, math.inf
    title = "a speed that is NaN, a command that is NaN, one that is infinite: all that follows"
    samples = spoilt.samples._replace(surge=surge, inputs=inputs)
    cases["nan"] = spoilt._replace(title=title, samples=samples, after=half, event=lead)

    jump = drive(twice, elements, 5, 2 ** rng.uniform(-1, 1, (elements, P)), lead)
    title = "all parameters jump by factors of ½ to 2: first 100 predictions"
    cases["jump"] = jump._replace(title=title, after=slice(lead, lead + 100), event=lead)

    fault = drive([("excited", ten_minutes)] * 2, elements, 6, np.repeat([1.0, 0.4, 1.0], 3), ten_minutes)
    title = "left thruster at 40 % from minute 10: first 100 predictions"
    cases["thruster"] = fault._replace(title=title, after=slice(ten_minutes, ten_minutes + 100), event=ten_minutes)

    silent = drive([("excited", lead), ("excited", outage), ("excited", lead)], elements, 7)
    back, samples = lead + outage, tree_map(torch.clone, silent.samples)
    samples.measured[lead:back], samples.inputs.dt[back] = False, 0.0  # the first speed opens a segment
    title = f"{outage * DT / 60:.0f} min without speed, commands go on: first 50 predictions after"
    cases["outage"] = silent._replace(title=title, samples=samples, after=slice(back + 1, back + 51), event=back)
    return cases


def default_ensemble(mass: float = 1.0, surge_max: float = SURGE_MAX) -> Ensemble:
    """The weighted members of `configs/train.yaml`, told the boat's mass and top speed."""
    with initialize_config_dir(str(Path(__file__).parents[1] / "configs"), version_base="1.3"):
        cfg = compose("train", [f"vehicle.mass={mass}", f"vehicle.surge_max={surge_max}"])
    rule = instantiate(cfg.combiners.ensemble)
    return Ensemble({name: instantiate(cfg.estimators[name]) for name in rule.members}, {"ensemble": rule})


def ours() -> dict[str, Estimator]:
    """One of each kind, with the common memory, and the ensemble."""
    ensemble = default_ensemble()
    return {
        "rls": RLS(MODEL, forgetting=LAM),
        "sift_rls": SIFtRLS(MODEL, memory=SIFT_MEMORY),
        "robust_sift_rls": Robust(SIFtRLS(MODEL, memory=SIFT_MEMORY)),
        "robust_huber": Robust(SIFtRLS(MODEL, memory=SIFT_MEMORY), threshold=1.345),
        "aid": AID(model=MODEL),
        "robust_aid": Robust(AID(model=MODEL)),
        "arx": ARX(),
        "joint_ekf": JointEKF(SURGE_MAX),
        "joint_quick": ensemble.members["joint_quick"],
        "ensemble": ensemble,
        "persistence": Persistence(),
    }


def regressors(samples: Sample) -> Tensor:
    """φ at the speeds measured, `(time, elements, p)`."""
    return MODEL(torch.cat([torch.zeros_like(samples.surge[:1]), samples.surge[:-1]]), samples.inputs)[1]


def excitation(scenario: Scenario) -> Tensor:
    """C, `(p, p)`."""
    phi = regressors(tree_map(lambda x: x[: scenario.lead], scenario.samples)).flatten(0, 1)
    return phi.mT @ phi / len(phi)


def run_ours(scenario: Scenario, estimator: Estimator) -> Result:
    with torch.no_grad():
        state, surges, _ = rollout(estimator, estimator.init(scenario.target.shape[1:]), scenario.samples)
    return assess(scenario, surges, all(bool(leaf.isfinite().all()) for _, leaf in named_leaves(state)))


def follow(peer: Peer, samples: Sample) -> Tensor:
    """A peer's predictions over the samples of one batch element, `(time,)`."""
    phi = regressors(tree_map(lambda x: x[:, None], samples))[:, 0].numpy()
    surge, measured, dt = samples.surge.numpy(), samples.measured.numpy(), samples.inputs.dt.numpy()
    speed, coasts, predictions = 0.0, False, np.full(len(surge), np.nan)
    for k in range(len(surge)):
        if dt[k] == 0:
            speed, coasts = surge[k], False
            continue
        x = phi[k]
        if coasts:
            x = MODEL(torch.tensor(speed), Inputs(*(each[k] for each in samples.inputs)))[1].numpy()
        predictions[k] = speed + peer.predict(x)
        if measured[k]:
            peer.learn(x, surge[k] - speed)
        speed, coasts = (surge[k], False) if measured[k] else (predictions[k], True)
    return torch.from_numpy(predictions)


def run_peer(scenario: Scenario, make: Callable[[], Peer]) -> Result:
    surges, finite = torch.full_like(scenario.target, math.nan), True
    for element in range(scenario.target.shape[1]):
        peer = make()
        try:
            surges[:, element] = follow(peer, tree_map(lambda x, element=element: x[:, element], scenario.samples))
        except np.linalg.LinAlgError:  # it gave up: a singular matrix
            finite = False
        finite = finite and all(np.isfinite(x).all() for x in peer.numbers())
    return assess(scenario, surges, finite)


def assess(scenario: Scenario, surges: Tensor, finite: bool) -> Result:
    inputs, steps = scenario.samples.inputs, None
    asked = (inputs.dt > 0) & torch.stack([x.isfinite() for x in inputs]).all(0)
    error = (surges - scenario.target).abs().nan_to_num(math.inf)
    error = torch.where(asked, error, math.nan)
    if scenario.event is not None:
        level = error[scenario.lead // 2 : scenario.lead].nanmean()
        later = error[scenario.event :]
        running = later.unfold(0, min(WINDOW // error.shape[1], len(later)), 1).nanmean((1, 2))
        beyond = (running > WITHIN * level).nonzero()
        steps = float(beyond[-1]) + 1 if len(beyond) else 0.0
        steps = math.inf if steps == len(running) else steps
    return Result(float(error[scenario.after].nanmean()), steps, finite and bool(surges[asked].isfinite().all()))


def true_model(scenario: Scenario) -> Result:
    """The error that noise alone makes: θ at the end, and speeds with which nothing went wrong."""
    clean = scenario.samples._replace(surge=scenario.target)
    before = torch.cat([torch.zeros_like(scenario.target[:1]), scenario.target[:-1]])
    surges = before + (regressors(clean) * scenario.theta).sum(-1)
    return assess(scenario._replace(event=None), surges, True)


def cell(result: Result) -> str:
    if not result.finite:
        return "**not finite**"
    error = f"{result.error:.4f}" if result.error < 10 else f"{result.error:.0e}"
    return error + ("" if result.steps is None else ", never" if math.isinf(result.steps) else f", {result.steps:.0f}")


def report(steps: int) -> str:
    cases = scenarios(steps)
    by_name: dict[str, dict[str, Result]] = {}
    for case, scenario in cases.items():
        results = {"true model": true_model(scenario)}
        results |= {name: run_peer(scenario, make) for name, make in peers(excitation(scenario)).items()}
        results |= {name: run_ours(scenario, one) for name, one in ours().items()}
        for name, result in results.items():
            by_name.setdefault(name, {})[case] = result
        print(case, flush=True)
    rows = [[name, *(cell(x) for x in row.values())] for name, row in by_name.items()]
    return "\n".join([
        "# Stress tests beside other libraries", "", *__doc__.strip().splitlines()[4:], "",
        f"Measured on {machine()}; ours are streamed. A cell: the MAE of one-step",
        "predictions, m/s, over the steps named below; and after how many steps from the event the error (mean over",
        f"{WINDOW} samples) stays within {WITHIN} × its level before. *Not finite*: a prediction or the state.", "",
        *(f"- {case}: {scenario.title}" for case, scenario in cases.items()), "", *table(["", *cases], rows), "",
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="limit of every part of a scenario")
    parser.add_argument("--boats", type=int, default=5, help="of each plant, to which something happens")
    given = parser.parse_args()
    torch.set_num_threads(1)
    import faults  # which imports this module

    with np.errstate(all="ignore"):
        text = "\n".join([report(given.steps), *faults.section(SEED, given.boats, GUSTY / given.boats)])
    if given.steps >= 1_000_000:
        publish(__file__, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
