"""What a step, a log line and a curve cost, as ratios measured in one run; writes `benchmarks/results.md`.

python benchmarks/core.py
"""

import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import accuracy
import numpy as np
import torch

from usvlearn import AID, RLS, RNN, Average, Ensemble, Persistence, RecursiveWeights, SurgeDynamics, rollout
from usvlearn.estimator import simulate
from usvlearn.evaluation.crossval import cross_validate
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.learning.replay import replay
from usvlearn.learning.run_folder import RunFolder
from usvlearn.learning.watch import Watch
from usvlearn.logs.alog import Alog
from usvlearn.logs.channel import Source
from usvlearn.logs.fleet import align_fleet
from usvlearn.signals import tree_map
from usvlearn.simulate.fleet import fleet as simulated

REPEATS = 3
SETTINGS = {"estimators": {}, "combiners": {}, "align": {}, "data": {}}


def once(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def seconds(work: Callable[[], object]) -> float:
    """Median time of a call."""
    return statistics.median(once(work) for _ in range(REPEATS))


def ratio(work: Callable[[], object], reference: Callable[[], object]) -> float:
    """Median over pairs, measured in turn, of the one's time over the other's: a drifting machine harms it least."""
    return statistics.median(once(work) / once(reference) for _ in range(REPEATS))


def ensemble() -> Ensemble:
    members = {"aid": AID(28.0), "rls": RLS(), "dynamic_rls": RLS(SurgeDynamics(28.0)), "rnn": RNN()}
    paper = ["aid", "rls", "rnn"]
    rules = {"average": Average(paper), "weighted": RecursiveWeights(paper)}
    return Ensemble({**members, "persistence": Persistence()}, rules)


def steps(run) -> list[str]:
    """Time per step and lane of each estimator, in a stream of samples without gradients."""
    rows = [
        "| estimator | 1 lane, µs/step | 8 lanes | 512 lanes | µs per lane-step at 512 | gain of lanes |",
        "|---|" + "---:|" * 5,
    ]
    for name, estimator in {**ensemble().members, "ensemble": ensemble()}.items():
        costs = []
        for lanes in (1, 8, 512):
            one = tree_map(lambda x, n=lanes: torch.from_numpy(x[:200, :1]).expand(-1, n), run.samples)
            state = estimator.init((lanes,))
            with torch.no_grad():
                costs.append(seconds(lambda e=estimator, s=state, x=one: rollout(e, s, x)) / 200 * 1e6)
        first, eight, many = costs
        rows.append(
            f"| {name} | {first:.0f} | {eight:.0f} | {many:.0f} | {many / 512:.2f} | {first / (many / 512):.0f}× |"
        )
    return rows


def logging(fleet) -> str:
    """Time in TensorBoard, checkpoints and predictions over time in the replay itself, within one run."""
    model, shares = ensemble(), []
    for _ in range(REPEATS):
        with (
            tempfile.TemporaryDirectory() as folder,
            Watch(folder, fleet, model) as watch,
            RunFolder(folder, fleet, {}) as archive,
        ):
            start = archive.begin(model.init((len(fleet.boats),)), None)
            began, spent = time.perf_counter(), 0.0
            for chunk in replay(model, fleet, start.state, every=watch.every):
                spent += once(lambda c=chunk, a=archive: a.save(c))
                spent += once(lambda c=chunk, w=watch: w.show(c))
            boats = fleet_scores(fleet, archive.published, model.names)
            spent += once(
                lambda w=watch, s=boats, a=archive: w.finish(
                    SETTINGS, s, a.published, {boat: [] for boat in fleet.boats}
                )
            )
            shares.append(spent / (time.perf_counter() - began - spent))
    share = statistics.median(shares)
    return f"- {len(fleet.boats)} boats, {fleet.steps} steps: logging and saving cost {share:.1%} of the replay"


def judging(sets: int = 80, hours: float = 30.0) -> str:
    """Cross-validation of the default ensemble as lanes, against one set on one run."""
    model = accuracy.ensemble(())
    fleet = align_fleet(simulated(n=1, hours=hours, mission_minutes=15.0))
    runs = [tree_map(lambda x, n=run.lengths[0]: x[:n, 0], run.samples) for run in fleet.runs]
    lanes = model.init((sets,))
    spent = once(lambda: cross_validate(model, lanes, runs))
    one = tree_map(lambda x: torch.from_numpy(x)[:, None], runs[0])
    with torch.no_grad():
        single = seconds(lambda: simulate(model, model.init((1,)), one)) / len(one.surge)
    each = spent / (sets * sum(len(run.surge) for run in runs))
    return (
        f"- {sets} sets × {len(runs)} runs, {hours:g} h, of the default ensemble are simulated free in {spent:.0f} s: "
        f"{each * 1e6:.1f} µs a step, {single / each:.0f} × less than for one set on one run"
    )


def split(path: Path) -> None:
    with path.open() as file:
        for line in file:
            line.split(None, 3)


def lines() -> str:
    """A 260k-line `.alog`, against the time to split its lines and nothing else."""
    names = [f"VAR_{k}" for k in range(60)] + ["NAV_SPEED", "NAV_HEADING", "DESIRED_THRUST_L", "DESIRED_THRUST_R"]
    rng = np.random.default_rng(0)
    rows = [f"{k * 0.01:<15.3f} {names[k % 64]:<20} pApp {rng.random():.5f}" for k in range(260_000)]
    sources = {name: Source(variable) for name, variable in zip(
        ("surge", "heading", "command_left", "command_right"), names[60:], strict=True)}  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.alog"
        path.write_text("%% LOGSTART 0\n" + "\n".join(rows) + "\n")
        ours = seconds(lambda: Alog().read(path, sources))
        share = ratio(lambda: Alog().read(path, sources), lambda: split(path))
    return f"- a 260,000-line `.alog` is read in {ours:.2f} s, {share:.1f} × the time to split its lines"


def main() -> None:
    torch.set_num_threads(1)
    one, eight = (align_fleet(simulated(n=n, hours=1.0, mission_minutes=10.0)) for n in (1, 8))
    machine = f"{platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}, one thread"
    text = ["# Core", "", f"Measured by `python benchmarks/core.py` on {machine}; medians of {REPEATS}.", ""]
    text += [*steps(one.runs[0]), "", logging(one), logging(eight), lines(), judging(), ""]
    print("\n".join(text))
    (Path(__file__).parent / "results.md").write_text("\n".join(text))


if __name__ == "__main__":
    main()
