"""What a step, a grid and whole jobs cost, measured in one run.

python benchmarks/speed.py                       all, ten minutes; wants the extra bench and an idle machine
python benchmarks/speed.py --only steps          one section, printed alone
python benchmarks/speed.py --quick               all, on little data: whether it runs
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial

import accuracy
import torch
from pages import counted, machine, micro, publish, table
from speed_steps import QUICK, WHOLE, Effort, once, others, steps

from usvlearn import AID, Ensemble, Estimator, SIFtRLS, SurgeDynamics
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.evaluation.crossval import cross_validate
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder
from usvlearn.runs.tensorboard import TensorBoardLogger
from usvlearn.simulate.fleet import fleet as simulated
from usvlearn.sweeps.tuning.batches import element_errors

MASS, MISSION = 28.0, 15.0  # kg, minutes
MANY = 50_000_000  # element-steps of a job that is measured once
SETTINGS = {"estimators": {}, "combiners": {}, "align": {}, "data": {}}


@cache
def season(boats: int, hours: float) -> Fleet:
    return align_fleet(simulated(n=boats, hours=hours, mission_minutes=MISSION))


def replayed(ensemble: Ensemble, fleet: Fleet) -> None:
    for _ in replay(ensemble, fleet, ensemble.init((len(fleet.boats),))):
        pass


def grid_of(kind: str, settings: int) -> Estimator:
    """So many settings of one hyperparameter, as batch elements."""
    values = torch.logspace(-1, 1, settings, dtype=torch.float64)[:, None]
    return AID(MASS, values) if kind == "aid" else SIFtRLS(SurgeDynamics(MASS), 10 * values)


def jobs(effort: Effort) -> list[str]:
    """From aligned samples in memory to the end."""
    short, long = effort.hours
    ensemble = accuracy.ensemble(())
    rows = []

    def row(title: str, work, element_steps: int) -> None:
        repeats = 1 if element_steps > MANY else 3
        spent = statistics.median(once(work) for _ in range(repeats))
        rows.append([title, f"{element_steps:,}", f"{spent:.2f}", micro(spent / element_steps)])

    replayed(ensemble, season(1, short))  # compiled by now
    one = season(1, long)
    for boats in (1, 8):
        fleet = season(boats, long)
        title = f"{long:g} h of the default ensemble, {counted(boats, 'boat')}"
        row(title, partial(replayed, ensemble, fleet), fleet.steps * boats)
    for kind in ("aid", "sift"):
        estimator = grid_of(kind, effort.settings)
        element_errors(estimator, season(1, short), (effort.settings,))
        title = f"{effort.settings} settings of one {kind} × {long:g} h"
        row(title, partial(element_errors, estimator, one, (effort.settings,)), effort.settings * one.steps)
    runs = [tree_map(lambda x, n=run.lengths[0]: x[:n, 0], run.samples) for run in one.runs]
    cross_validate(ensemble, ensemble.init((1,)), runs[:1])
    title = f"cross-validation, {effort.sets} sets × {long:g} h"
    work = partial(cross_validate, ensemble, ensemble.init((effort.sets,)), runs)
    row(title, work, effort.sets * one.steps)
    note = f"Medians of 3, of jobs beyond {MANY // 1_000_000} million element-steps once. One thread."
    return [*table(["job", "element-steps", "s", "µs an element-step"], rows), "", note]


def around(effort: Effort) -> list[str]:
    """What a replay is surrounded by, as a share of it."""
    hours = min(1.0, effort.hours[1])
    return [logging(season(1, hours), effort), logging(season(8, hours), effort)]


def logging(fleet: Fleet, effort: Effort) -> str:
    """Time in TensorBoard, checkpoints and predictions over time in the replay itself, within one run."""
    model, shares, seconds = accuracy.ensemble(()), [], []
    for _ in range(effort.repeats):
        with (
            tempfile.TemporaryDirectory() as folder,
            TensorBoardLogger(folder, fleet, model) as watch,
            RunFolder(folder, fleet, model, {}) as archive,
        ):
            start = archive.begin(model.init((len(fleet.boats),)), None)
            began, spent = time.perf_counter(), 0.0
            for chunk in replay(model, fleet, start.state, every=watch.every):
                spent += once(partial(archive.save, chunk)) + once(partial(watch.show, chunk))
            boats = fleet_scores(fleet, archive.published, model.names)
            results = {"boats": boats, "events": {boat: [] for boat in fleet.boats}}
            spent += once(partial(watch.finish, SETTINGS, results, archive.published))
            seconds.append(spent)
            shares.append(spent / (time.perf_counter() - began - spent))
    boats = counted(len(fleet.boats), "boat")
    return (
        f"- {boats}, {fleet.steps} steps: logging and saving take {statistics.median(seconds):.2f} s, "
        f"{statistics.median(shares):.0%} of the replay of the default ensemble"
    )


SECTIONS: dict[str, tuple[str, Callable[[Effort], list[str]]]] = {
    "steps": ("A step", steps),
    "others": ("Other libraries", others),
    "jobs": ("Whole jobs", jobs),
    "around": ("Around a replay", around),
}


def page(effort: Effort, names: list[str]) -> str:
    """The page, as Markdown."""
    text = [
        "# Speed of steps and jobs",
        "",
        "Measured by `python benchmarks/speed.py` in one run: float64, one thread where not said otherwise, medians of",
        f"{effort.repeats} rounds in which all works of a row are timed in turn.",
        "",
        f"{machine()}.",
        "",
    ]
    for name in names:
        title, measure = SECTIONS[name]
        print(f"{title} …", flush=True)
        text += [f"## {title}", "", *measure(effort), ""]
    return "\n".join(text)


@torch.no_grad()
def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section, printed alone")
    asked.add_argument("--quick", action="store_true", help="on little data")
    given = asked.parse_args()
    torch.set_num_threads(1)
    text = page(QUICK if given.quick else WHOLE, [given.only] if given.only else list(SECTIONS))
    if given.only is None and not given.quick:
        publish(__file__, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
