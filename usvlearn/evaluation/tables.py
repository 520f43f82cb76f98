"""Tables for the terminal."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from usvlearn.evaluation.metrics import mean_mae

MOST_COLUMNS = 5  # of estimators, for which a terminal has room beside the settings
COLUMNS = ("mae", "median", "rmse", "skill")


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _best(maes: Mapping[str, float | None]) -> str | None:
    known = {name: mae for name, mae in maes.items() if mae is not None}
    return min(known, key=known.get) if known else None


def score_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per boat and estimator: errors in m/s, skill, the interval, steps; the best of each boat is bold."""
    table = Table(title="One-step prediction of surge, errors in m/s", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("boat")
    table.add_column("estimator", no_wrap=True)
    for column in ("MAE", "median", "RMSE", "skill", "±", "covers", "steps"):
        table.add_column(column, justify="right")
    for boat, rows in boats.items():
        best = _best({name: row["mae"] for name, row in rows.items()})
        for k, (name, row) in enumerate(rows.items()):
            cells = [_number(row[column], 3 if column == "skill" else 4) for column in COLUMNS]
            covers = row.get("coverage")
            cells += [_number(row.get("halfwidth"), 3), "–" if covers is None else f"{covers:.1%}"]
            style = "bold" if name == best else None
            steps = f"{row['steps']}" + (f", {row['diverged']} diverged" if row.get("diverged") else "")
            table.add_row(boat if k == 0 else "", name, *cells, steps, style=style)
        table.add_section()
    return table


def fleet_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per estimator, one column per boat and one for their mean: MAE in m/s, the best of each column bold."""
    table = Table(title="The fleet: MAE in m/s", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    columns = {boat: {name: row["mae"] for name, row in scores.items()} for boat, scores in boats.items()}
    columns["mean"] = {name: None if mae != mae else mae for name, mae in mean_mae(boats).items()}
    table.add_column("estimator", no_wrap=True)
    for boat in columns:
        table.add_column(boat, justify="right", overflow="fold", min_width=6)
    best = {boat: _best(maes) for boat, maes in columns.items()}
    for name in columns["mean"]:
        cells = (Text(_number(maes.get(name)), "bold" if name == best[boat] else "") for boat, maes in columns.items())
        table.add_row(name, *cells)
    return table


def rejection_table(rejected: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Table | None:
    """One row per boat and channel, with the counts by cause; None where nothing was rejected."""
    table = Table(title="Rejected: messages by cause, and stale steps", title_justify="left", box=SIMPLE_HEAD)
    for column in ("boat", "channel", "causes"):
        table.add_column(column)
    for boat, channels in rejected.items():
        told = [
            (channel, ", ".join(f"{cause} {n}" for cause, n in causes.items())) for channel, causes in channels.items()
        ]
        for k, (channel, causes) in enumerate(told):
            table.add_row(boat if k == 0 else "", channel, causes)
        table.add_section()
    return table if table.row_count else None


def report(boats: Mapping[str, Mapping[str, Mapping]], rejected: Mapping, alarms: Mapping[str, Sequence]) -> Group:
    """All tables of a run, for the console, and a line for each alarm."""
    tables = [rejection_table(rejected), score_table(boats), fleet_table(boats) if len(boats) > 1 else None]
    told = [
        Text(f"alarm: {boat}, run {each['run']}, {each['time']:.0f} s: the {each['side']} thruster has lost thrust")
        for boat, raised in alarms.items()
        for each in raised
    ]
    return Group(*filter(None, tables), *told)


def differing(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """The keys whose values are not the same in all jobs.

    >>> differing([{"dt": "0.4", "gain": "1"}, {"dt": "0.4", "gain": "3"}])
    ['gain']
    """
    keys = dict.fromkeys(key for each in settings for key in each)
    return [key for key in keys if len({each.get(key) for each in settings}) > 1]


def told(settings: Mapping[str, str], keys: Sequence[str]) -> str:
    """What a job sets, of `keys` or else of all, in short.

    >>> told({"estimators.aid.gain": "3", "align.dt": "0.4"}, ["estimators.aid.gain"])
    'aid.gain=3'
    """
    shown = {key: settings[key] for key in keys if key in settings} or settings
    return " ".join(f"{_short(key)}={value}" if value else _short(key) for key, value in shown.items())


def _short(key: str) -> str:
    return ".".join(key.split(".")[-2:])


def ranked(jobs: Sequence) -> list:
    """Jobs by their objective, the best first; those that failed come last, in their order.

    >>> ranked([({}, {"error": "bad"}), ({}, {"boats": {}, "objective": 0.1})])[0]
    ({}, {'boats': {}, 'objective': 0.1})
    """

    def objective(job) -> tuple[bool, float]:
        found = job[-1].get("objective")
        return "boats" not in job[-1], float("inf") if found is None else found

    return sorted(jobs, key=objective)


def closing(results: Mapping, folder: Path) -> list[str]:
    """The last lines of a run: what it came to, and how to look at it.

    >>> closing({"seconds": 2.0, "output": "ensemble", "objective": 0.05}, Path("run"))[1]
    'To look at the run: tensorboard --logdir run'
    """
    found = f"{results['seconds']:.1f} s; MAE of {results['output']}: {results['objective']:.4f} m/s"
    look = f"To look at the run: tensorboard --logdir {shlex.quote(str(folder))}"
    return [f"{found}; results and parameter sets: {folder}", look]


def sweep_table(jobs: Sequence[tuple[Mapping[str, str], Mapping]]) -> Group:
    """One row per job of a sweep, the best first: what differs in its settings, and MAE, mean over boats.

    Shown are the estimators whose MAE differs between jobs (the last alone where they are many), and each job's best.

    Args:
        jobs: settings by key, and results as in `results.json`; `{"error": …}` of a job that failed, {} of one that did
            not finish.
    """
    done = [(settings, result) for settings, result in ranked(jobs) if "boats" in result]
    keys = differing([settings for settings, _ in jobs])
    means = [mean_mae(result["boats"]) for _, result in done]
    names = list(dict.fromkeys(name for maes in means for name in maes))
    moved = [name for name in names if len({maes.get(name) for maes in means}) > 1] or names
    shown = [name for name in moved if len(moved) <= MOST_COLUMNS or name == names[-1]]
    table = Table(
        title="Sweep: MAE in m/s, mean over boats", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for key in keys:
        table.add_column(_short(key), overflow="fold")
    for name in [*shown, "best"]:
        table.add_column(name, justify="right", no_wrap=True)
    for settings, result in done:
        maes = {name: None if mae != mae else mae for name, mae in mean_mae(result["boats"]).items()}
        best = _best(maes)
        cells = [_number(maes.get(name)) for name in shown] + ["–" if best is None else f"{best} {_number(maes[best])}"]
        table.add_row(*(str(settings.get(key, "")) for key in keys), *cells)
    failed = [
        Text(f"failed: {told(settings, keys)}: {result.get('error', 'did not finish')}")
        for settings, result in jobs
        if "boats" not in result
    ]
    return Group(*([table] if done else []), *failed)


def tuning_table(title: str, rows: Sequence[tuple[str, str, Mapping]]) -> Table:
    """One row per setting: its rank or name, the setting, MAE in m/s, mean over boats, and the gain over the default.

    Args:
        title: of the table.
        rows: rank, setting in words, and `mae` and `gain` (percent), None where it diverged.
    """
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("", no_wrap=True)
    table.add_column("setting", overflow="fold")
    table.add_column("MAE, m/s", justify="right")
    table.add_column("gain, %", justify="right")
    for k, (rank, setting, row) in enumerate(rows):
        mae = "diverged" if row["mae"] is None else f"{row['mae']:.5f}"
        table.add_row(rank, setting, mae, _number(row.get("gain"), 1), style=None if k else "bold")
    return table
