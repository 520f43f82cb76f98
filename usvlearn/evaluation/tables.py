"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table

from usvlearn.evaluation.metrics import mean_mae

COLUMNS = ("mae", "median", "rmse", "skill")


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _best(maes: Mapping[str, float | None]) -> str | None:
    known = {name: mae for name, mae in maes.items() if mae is not None}
    return min(known, key=known.get) if known else None


def score_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per boat and estimator: MAE, median and RMSE in m/s, skill, steps; the best of each boat is bold."""
    table = Table(title="One-step prediction of surge, errors in m/s", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("boat")
    table.add_column("estimator")
    for column in ("MAE", "median", "RMSE", "skill", "steps"):
        table.add_column(column, justify="right")
    for boat, rows in boats.items():
        best = _best({name: row["mae"] for name, row in rows.items()})
        for k, (name, row) in enumerate(rows.items()):
            cells = [_number(row[column], 3 if column == "skill" else 4) for column in COLUMNS]
            style = "bold" if name == best else None
            table.add_row(boat if k == 0 else "", name, *cells, str(row["steps"]), style=style)
        table.add_section()
    return table


def fleet_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per boat and one for their mean, one column per estimator: MAE in m/s, the best of each row bold."""
    table = Table(title="The fleet: MAE in m/s", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    rows = {boat: {name: row["mae"] for name, row in scores.items()} for boat, scores in boats.items()}
    rows["mean"] = {name: None if mae != mae else mae for name, mae in mean_mae(boats).items()}
    table.add_column("boat", no_wrap=True)
    for name in rows["mean"]:
        table.add_column(name, justify="right", no_wrap=True)
    for boat, maes in rows.items():
        if boat == "mean":
            table.add_section()
        best = _best(maes)
        cells = [f"[bold]{_number(maes[name])}[/]" if name == best else _number(maes[name]) for name in rows["mean"]]
        table.add_row(boat, *cells)
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


def report(boats: Mapping[str, Mapping[str, Mapping]], rejected: Mapping) -> Group:
    """All tables of a run, for the console."""
    tables = [rejection_table(rejected), score_table(boats), fleet_table(boats) if len(boats) > 1 else None]
    return Group(*filter(None, tables))


def sweep_table(jobs: Sequence[tuple[str, Mapping]]) -> Table:
    """One row per job of a sweep, the best first: its overrides, and the MAE of each estimator, mean over boats."""
    done = [(name, result) for name, result in jobs if "boats" in result]
    failed = [(name, result.get("error", "did not finish")) for name, result in jobs if "boats" not in result]
    names = list(dict.fromkeys(n for _, r in done for rows in r["boats"].values() for n in rows))
    table = Table(title="Sweep: MAE in m/s, mean over boats, best job first", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("job")
    for name in names:
        table.add_column(name, justify="right")
    for job, result in sorted(done, key=lambda item: item[1]["objective"] or float("inf")):
        maes = mean_mae(result["boats"])
        table.add_row(job, *(f"{maes[name]:.4f}" if name in maes else "–" for name in names))
    for job, reason in failed:
        table.add_row(job, f"failed: {reason}", style="red")
    return table
