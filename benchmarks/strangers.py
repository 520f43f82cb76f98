"""Errors and coverage of a fit on boats whose equations are not ours, and of forecasts of such boats.

python benchmarks/strangers.py [--seeds 30] [--boats NAME ...] [--forecasts 2]      writes docs/benchmarks/strangers.md

The boats are those of the file USVLEARN_STRANGERS, of ../shared/strangers/boats.py, or else of `other_boat.py`. Their
owner takes all that `usvlearn inspect` proposes, and gives the mass. The script needs the extra bench.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import statistics
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import batch
import numpy as np
import output_error
import torch
from fit import polynomial, squares
from pages import publish, table
from peers import echo_state, narmax, physics, state_space
from peers.batch import cut, errors

from usvlearn import learn, read
from usvlearn.composition.configuration import ensemble_of
from usvlearn.core.samples import Sample
from usvlearn.errors import UsvlearnError
from usvlearn.estimators.axis.turning_quantities import OF_FIT
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.joint.quantities import QUANTITIES

ROOT = Path(__file__).parents[1]
SEEDS, MINUTES, KINDS = (30,), 45.0, {3: "three missions", 1: "one log"}
FIT, ONLINE, BATCH, SQUARES = "fit", "online", "batch output error", "least squares"
PEERS = {"SysIdentPy": narmax, "jax-sysid": state_space, "echo state network": echo_state, BATCH: physics}
AHEAD, LEARNED = (1, 13, 25, 75), 2 / 3  # steps of 0.4 s; share of the logs that is learned before forecasts
ABSOLUTE = {"dead_zone": "of full", "compass_offset": "deg"}  # whose errors are not relative: they may be 0


Log = namedtuple("Log", "name missions sensors mass top truth read runs")  # what an owner has, and does not know
Row = namedtuple("Row", "missions sensors name method error half holds")  # a quantity of a log; NaN: it is not told


def strangers() -> ModuleType:
    """The module with the boats."""
    path = Path(os.environ.get("USVLEARN_STRANGERS", ROOT.parent / "shared" / "strangers" / "boats.py"))
    if not path.is_file():
        return importlib.import_module("other_boat")
    sys.path.append(str(path.parent))
    return importlib.import_module(path.stem)


def logged(boats: ModuleType, name: str, seed: int, missions: int, folder: Path, minutes: float = MINUTES) -> Log:
    """The logs of a boat, as `usvlearn inspect` proposes to read them."""
    boat, rng = boats.BOATS[name], np.random.default_rng([seed, *name.encode()])
    logs, description = folder / name, folder / f"{name}.yaml"
    logs.mkdir(parents=True)
    for k in range(missions):
        boats.write(logs / f"mission_{k + 1}.csv", boat, boats.mission(boat, minutes * 60 / missions, rng))
    command = [sys.executable, "-m", "usvlearn", "inspect", str(logs), "--name", name, "--output", str(description)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    facts, read_logs = asdict(boat), read(data=str(description), mass=boat.mx)
    heading = read_logs.settings["data"]["channels"].get("heading") or {}
    sensors = f"{'gyro, ' * facts['gyro']}{'signed speed' if facts.get('signed') else 'course'}"
    sensors += f"{', position' * facts.get('position', True)}{', rudder' * bool(facts.get('rudder'))}"
    truth = boats.truth(boat) | {"dead_zone": boat.dead, "current": boat.current}
    truth["compass_offset"] = boat.declination - float(heading.get("zero") or 0.0)
    top, runs = float(read_logs.settings["vehicle"]["surge_max"]), [each.samples for each in read_logs.runs]
    return Log(name, missions, sensors, boat.mx, top, truth, read_logs, runs)


def rows_of(log: Log, said: list[str]) -> Iterator[Row]:
    """Every quantity by every method; adds to `said` what the fit said."""
    learned, began = learn(log.read), time.process_time()
    try:
        fitted = learned.fit()[log.name]
        methods, doubts = {FIT: fitted.quantities}, " ".join(fitted.doubts)
    except UsvlearnError as error:
        methods, doubts = {FIT: {}}, str(error)
    said += [f"{log.name}, {KINDS[log.missions]}: {time.process_time() - began:.1f} s; {doubts}"] if doubts else []
    methods |= {ONLINE: learned.identified()[log.name],
              SQUARES: polynomial(squares(log.runs, log.mass), log.top, log.mass),
              BATCH: polynomial(output_error.fit(log.runs, log.top).parameters, log.top, log.mass)}  # fmt: skip
    for method, values in methods.items():
        for name, true in log.truth.items():
            each, scale = values.get(name), 1.0 if name in ABSOLUTE else abs(true)
            value, low, high = each[:3] if each is not None else [math.nan] * 3
            half, holds = (high - low) / 2 / scale, low <= true <= high
            yield Row(log.missions, log.sensors, name, method, abs(value - true) / scale, half, holds)


@torch.no_grad()
def forecasts(log: Log) -> dict[str, list[float]]:
    """Skill of forecasts of the last third of a log, by method and horizon; [] without the library."""
    before, after = cut(log.runs, LEARNED)
    after = [run for run in after if len(run.surge) > max(AHEAD)]
    model = ensemble_of(log.read.settings)
    forecasts, column = batch.online_forecasts(model, before, after, AHEAD), model.names.index("ensemble")
    table = {"ours, online": skills(after, [each[..., column].T for each in forecasts])}
    for name, module in PEERS.items():
        try:
            peer = module.fit(before, log.top).model
            table[name] = skills(after, [peer.forecast(run, AHEAD) for run in after])
        except ModuleNotFoundError:
            table[name] = []
    return table


def skills(runs: Sequence[Sample], predicted: Sequence[np.ndarray]) -> list[float]:
    """1 − MAE/MAE(persistence) by horizon."""
    return [1 - mae / held for mae, held in errors(runs, predicted, AHEAD).values()]


def percent(x: float, name: str = "") -> str:
    return f"{x:.2f}°" if name == "compass_offset" else f"{x:.1%}"


def summary(rows: Sequence[Row], name: str = "") -> list[str]:
    """Told, holding, median error and median half-width of the rows of one method."""
    known = [each for each in rows if math.isfinite(each.half)]
    if not known:
        return [f"0 of {len(rows)}", "–", "–", "–"]
    middle = [statistics.median(getattr(each, key) for each in known) for key in ("error", "half")]
    held = np.mean([each.holds for each in known])
    return [f"{len(known)} of {len(rows)}", f"{held:.0%}", *(percent(x, name) for x in middle)]


def by_quantity(rows: Sequence[Row], missions: int) -> list[str]:
    lines = []
    for name in dict.fromkeys(each.name for each in rows):
        those = [each for each in rows if (each.missions, each.name) == (missions, name)]
        some = {method: [each for each in those if each.method == method] for method in (FIT, ONLINE, BATCH, SQUARES)}
        others = [[x.error for x in some[method] if math.isfinite(x.error)] for method in (BATCH, SQUARES)]
        middle = [percent(statistics.median(each)) if each else "–" for each in others]
        lines.append([name, *summary(some[FIT], name), *summary(some[ONLINE], name)[1:3], *middle])
    head = [KINDS[missions], "told", "holds", "error", "half-width", "online holds", "online error", BATCH, SQUARES]
    return table(head, lines)


def by_sensors(rows: Sequence[Row]) -> list[str]:
    lines, groups = [], {"surge": QUANTITIES, "turning": TURNING, "dead zone, compass, current": OF_FIT}
    fits, sets = [each for each in rows if each.method == FIT], dict.fromkeys(each.sensors for each in rows)
    for sensors, (group, names) in product(["all", *sets], groups.items()):
        those = [each for each in fits if sensors in ("all", each.sensors) and each.name in names]
        parts = [summary([each for each in those if each.missions == missions]) for missions in KINDS]
        wide = ["" if group.startswith("dead") else part[3] for part in parts]
        lines.append([sensors, group, *(f"{part[0]}, {part[1]}" for part in parts), *wide])
    heads = [f"{kind}{what}" for what in (": told, holds", ": half-width") for kind in KINDS.values()]
    return table(["sensors", "quantities", *heads], lines)


def page(rows: Sequence[Row], ahead: dict[str, dict[str, list[float]]], said: Sequence[str], command: str) -> list[str]:
    lines = []
    for name in ("ours, online", *PEERS) if ahead else ():
        known = [each[name] for each in ahead.values() if each.get(name)]
        lines.append([name, *([f"{x:.2f}" for x in np.median(known, 0)] if known else ["not installed", "", "", ""])])
    return [
        "# Boats whose equations are not ours", "",
        f"Made by `{command}`. The boats have sway, dead zones, lags, chop and the sensors that owners have; each log "
        f"of {MINUTES:g} min goes through `usvlearn inspect`. Nothing was chosen on these seeds. Errors are medians "
        "relative to the truth; of a dead zone in points of full command, of the compass in degrees. Intervals are of "
        "90 %.", "",
        "## By quantity", "", *by_quantity(rows, 3), "", *by_quantity(rows, 1), "",
        "## By sensors: the fit", "", *by_sensors(rows), "",
        "## Forecasts", "",
        f"Skill 1 − MAE/MAE(persistence) over the last third of one log, median of {len(ahead)} boats. Ours goes on "
        "learning up to each forecast, the others have learned the first two thirds at once.", "",
        *table(["", *(f"{0.4 * h:.1f} s" for h in AHEAD)], lines), "",
        "## What the fit said, where it had doubts, and its time of the processor", "", *(f"- {each}" for each in said),
    ]  # fmt: skip


def main() -> None:
    boats = strangers()
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    ask.add_argument("--boats", nargs="+", default=list(boats.BOATS), choices=list(boats.BOATS))
    ask.add_argument("--forecasts", type=int, default=2, help="so many boats")
    given = ask.parse_args()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    rows, ahead, said = list[Row](), dict[str, dict[str, list[float]]](), list[str]()
    for seed in given.seeds:
        for name in given.boats:
            for missions in KINDS:
                with TemporaryDirectory() as folder:
                    log = logged(boats, name, seed, missions, Path(folder))
                    rows += rows_of(log, said)
                print(seed, name, KINDS[missions], len(said), "doubts so far", flush=True)
                if missions == 1 and len(ahead) < given.forecasts:
                    ahead[name] = forecasts(log)
    options = f"--seeds {' '.join(map(str, given.seeds))} --forecasts {given.forecasts}"
    publish(__file__, page(rows, ahead, said, f"python benchmarks/strangers.py {options}"))


if __name__ == "__main__":
    main()
