"""Forecasts seconds ahead: skill and coverage by horizon, of recorded and simulated boats.

Writes `docs/benchmarks/forecast.md`.

python benchmarks/forecast.py LOGS        a folder with blueboat, vtec, dalian; five minutes

What was chosen (the members that are weighed, the overlap) was chosen on the first halves of the recorded runs and on
simulated boats of seeds 5 and 11. The second halves and seed 77 are reported.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accuracy import Log, configuration, ensemble, first_half, fleet_of, published, recorded
from hydra.utils import instantiate
from pages import publish, table
from seasons import NOMINAL, PLANTS

from usvlearn.core.samples import masks, tree_map
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.fit_member import with_fit
from usvlearn.engine.run import roll
from usvlearn.errors import UsvlearnError
from usvlearn.estimators.ensemble.forecasts.state import HORIZONS, TABLE
from usvlearn.evaluation.horizons import GROUPS, LEAST, ensemble_scores
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.hand_over import table_of
from usvlearn.model.fit.logs import fine, missions_of

REAL, SEED, HOURS = ("blueboat", "vtec", "dalian"), 77, 3
MANY = 100  # forecasts of a group, below which no coverage is stated
FITTED = (1, 2, 3, 4)  # missions of a simulated boat after which it is fitted; of a recorded one all
FIT_SEED = 501


def by_horizon(log: Log, more: tuple[str, ...] = (), part: np.ndarray | None = None) -> list[dict[str, Any]]:
    """Scores of the ensemble on a part of the log, by horizon, as of `usvlearn.evaluation.horizons`."""
    (model, runs), cut, begin = published(log.overrides, more), [], 0
    for run, step, arrays in runs:
        forecasts = arrays["forecasts"]
        if part is not None:
            forecasts = np.where(part[begin : begin + len(forecasts), None, None], forecasts, np.nan)
        begin += len(forecasts)
        cut.append((run, step, arrays | {"forecasts": forecasts}))
    boat = log.fleet.boats[log.element]
    return list(ensemble_scores(model, log.fleet, cut)[boat][model.output].values())


def column(rows: Sequence[dict[str, Any]], key: str) -> np.ndarray:
    """A score by horizon, NaN where it is not stated."""
    return np.array([np.nan if row[key] is None else row[key] for row in rows])


def simulated(seed: int = SEED) -> list[Log]:
    """Three boats of each of five plants."""
    logs = []
    for plant in PLANTS:
        mass, top = NOMINAL[plant]
        given = (f"data.plant={plant}", "data.n=3", f"data.hours={HOURS}", f"data.seed={seed}", f"vehicle.mass={mass}",
                 f"vehicle.surge_max={top}")  # fmt: skip
        fleet = fleet_of(given)
        logs += [Log(boat, fleet, element, given) for element, boat in enumerate(fleet.boats)]
    return logs


def shown(values: Sequence[float], digits: int = 3) -> list[str]:
    return ["–" if not np.isfinite(x) else f"{x:.{digits}f}" for x in values]


def by_horizons(first: str, rows: Mapping[str, Sequence[str]]) -> list[str]:
    """A table with a column for each horizon."""
    return table([first, *(f"{h:g} s" for h in HORIZONS)], [[name, *cells] for name, cells in rows.items()])


def reported(real: Sequence[Log], boats: Sequence[Log]) -> list[str]:
    every, first = [by_horizon(log) for log in boats], {log.name: by_horizon(log, (), first_half(log)) for log in real}
    second = {log.name: by_horizon(log, (), ~first_half(log)) for log in real}
    simulated = {key: np.stack([column(rows, key) for rows in every]) for key in ("skill", "covers", "steps")}
    skills = {}
    for name in second:
        skills |= {f"{name}, {half} half": shown(column(rows[name], "skill"))
                   for half, rows in (("second", second), ("first", first))}  # fmt: skip
    skills |= {f"{len(boats)} simulated boats, mean": shown(simulated["skill"].mean(0))}
    skills |= {"the least of them": shown(simulated["skill"].min(0))}
    covers, counts = ({f"{name}, second half": shown(column(rows, key), digits) for name, rows in second.items()}
                      for key, digits in (("covers", 2), ("steps", 0)))  # fmt: skip
    covers |= {f"simulated boats, {name}": shown(reduce(simulated["covers"], 0), 2)
               for name, reduce in (("mean", np.mean), ("least", np.min), ("greatest", np.max))}  # fmt: skip
    counts |= {"a simulated boat, median": shown(np.median(simulated["steps"], 0), 0)}
    return [
        *by_horizons("skill", skills), "",
        *by_horizons("share of the speeds within the intervals of 90 %", covers), "",
        *by_horizons("forecasts", counts),
    ]  # fmt: skip


def manoeuvres(real: Sequence[Log], boats: Sequence[Log]) -> Iterator[str]:
    """The section on coverage by group, and on the interval score beside that of `conditional=false`."""
    yield "## Intervals by how far the commands move"
    yield ""
    yield "Share inside where the commands stay / move / move much: the range of the mean command within the horizon is"
    yield "below .05, at most .25, or more. *Score* is the interval score over that of intervals that do not know the"
    yield f"manoeuvre. Whole logs; – : fewer than {MANY} forecasts. Settings were chosen on boats of seed 9301 and on"
    yield "the recorded boats; seed 77 is reported."
    yield ""
    groups = {label: [by_manoeuvre(log) for log in logs] for label, logs in _groups(real, boats).items()}
    inside, scores = {}, {}
    for label, each in groups.items():
        shares, score = np.stack([x[:3] for x in each]), np.stack([x[3] for x in each])
        several = {", least": np.nanmin, ", greatest": np.nanmax} if len(each) > 1 else {}
        for what, reduce in {"": np.nanmean, **several}.items():
            inside[label + what] = [" / ".join(_share(x) for x in column) for column in reduce(shares, 0).T]
        scores[label] = shown(np.nanmean(score, 0))
        scores |= {f"{label}, worst": shown(np.nanmax(score, 0))} if several else {}
    yield from by_horizons("share inside", inside)
    yield ""
    yield from by_horizons("score", scores)


def _groups(real: Sequence[Log], boats: Sequence[Log]) -> dict[str, Sequence[Log]]:
    return {log.name: [log] for log in real} | {f"{len(boats)} simulated boats": boats}


def _share(x: float) -> str:
    return f"{x:.2f}" if np.isfinite(x) else "–"


def by_manoeuvre(log: Log) -> np.ndarray:
    """Coverage of the three groups, and the ratio of the interval scores, `(4, horizons)`; NaN where few."""
    rows, before = by_horizon(log), by_horizon(log, ("conditional=false",))
    shares = [np.where(column(rows, f"steps_{x}") >= MANY, column(rows, f"covers_{x}"), np.nan) for x in GROUPS]
    return np.stack([*shares, column(rows, "interval") / column(before, "interval")])


def with_fits(given: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray] | None:
    """Skill by horizon without and with fits that are handed over between missions, from the first one on; None where
    no fit was without doubts.
    """
    cfg, fits = configuration(given), {}
    logs = instantiate(cfg.data)
    fleet, small = (align_fleet(logs, **how) for how in (cfg.align, fine(cfg.align)))
    (boat,), model = fleet.boats, ensemble(given)
    for k in range(1, len(fleet.runs)):
        if k in FITTED or given[0].startswith("data="):
            with suppress(UsvlearnError):
                missions = missions_of(small._replace(runs=small.runs[:k]), boat)
                fits[k] = fit_boat(boat, missions, cfg.vehicle.mass, cfg.vehicle.surge_max)
    first = min((k for k, fit in fits.items() if not fit.doubts), default=0)
    errors: list[list[np.ndarray]] = [[], []]
    for with_them, part in enumerate(errors):
        description, leaves = model.description(), arrays_of(model.init((1,)))
        for k, run in enumerate(fleet.runs):
            if with_them and k in fits and k >= first:
                table = [0.0] * TABLE if fits[k].doubts else table_of(fits[k])
                leaves, description = with_fit(leaves, description, table)
            samples = tree_map(lambda x: np.ascontiguousarray(x), run.samples)
            leaves, _, record = roll(description, leaves, samples, record=["forecasts.predictions"])
            surge = np.where(masks(run.samples).learns, run.samples.surge, np.nan)
            if k >= first:
                part.append(record["forecasts.predictions"][:, 0, :, -2:] - surge[..., None])
    skills = []
    for part in errors:
        held, ahead = np.moveaxis(np.abs(np.concatenate(part)), -1, 0)
        enough = np.isfinite(ahead).sum(0) >= LEAST
        skills.append(np.where(enough, 1 - np.nanmean(ahead, 0) / np.nanmean(held, 0), np.nan))
    return (skills[0], skills[1]) if first else None


def fitted(folder: Path) -> Iterator[str]:
    """The section on the batch fit as a member."""
    yield "## With a batch fit {#with-a-batch-fit}"
    yield ""
    yield "As in a node, the fit of the missions so far joins after each mission, of simulated boats after 1 to 4 of"
    yield f"20 min, seed {FIT_SEED}. Skill after the first fit without doubts, without → with it."
    yield "– : too few forecasts, or no such fit. The prior weight was chosen on other seeds."
    yield ""
    boats, rows = {name: (f"data={name}", f"data.path={folder / name}") for name in REAL}, {}
    for plant in PLANTS:
        mass, top = NOMINAL[plant]
        boats[f"{plant}, simulated"] = (
            f"data.plant={plant}", "data.n=1", "data.hours=2", f"data.seed={FIT_SEED}", "data.mission_minutes=20",
            f"vehicle.mass={mass}", f"vehicle.surge_max={top}",
        )  # fmt: skip
    for name, given in boats.items():
        pair = with_fits(given) or np.full((2, len(HORIZONS)), np.nan)
        rows[name] = ["–" if not np.isfinite(a) else f"{a:.3f} → {b:.3f}" for a, b in zip(*pair, strict=True)]
    yield from by_horizons("", rows)


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    real, boats = [recorded(folder, name) for name in REAL], simulated()
    publish(__file__, [
        "# Accuracy of forecasts by horizon",
        "",
        "Measured by `python benchmarks/forecast.py LOGS`: the default configuration, learned online. Each forecast",
        "is made before anything after its origin is seen, and is told only the commands, headings and yaw rates that",
        "came. Skill is 1 − MAE/MAE(persistence from the same origins).",
        f"Simulated: five plants, 3 boats each, {HOURS} h, seed {SEED}. – : fewer than {LEAST} forecasts.",
        "",
        *reported(real, boats),
        "",
        *fitted(folder),
        "",
        *manoeuvres(real, boats),
        "",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
