"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table

from usvlearn.evaluation.metrics import mean_mae

COLUMNS = ("mae", "median", "rmse")


def score_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per boat and estimator: MAE, median and RMSE in m/s, skill, steps."""
    table = Table(title="One-step prediction of surge, error in m/s", title_justify="left")
    table.add_column("boat")
    table.add_column("estimator")
    for column in ("MAE", "median", "RMSE", "skill", "steps"):
        table.add_column(column, justify="right")
    for boat, rows in boats.items():
        best = min(row["mae"] for row in rows.values())
        for k, (name, row) in enumerate(rows.items()):
            cells = [f"{row[column]:.4f}" for column in COLUMNS]
            cells += ["–" if row["skill"] is None else f"{row['skill']:.3f}", str(row["steps"])]
            table.add_row(boat if k == 0 else "", name, *cells, style="bold" if row["mae"] == best else None)
        table.add_section()
    return table


def fleet_table(boats: Mapping[str, Mapping[str, Mapping]]) -> Table:
    """One row per estimator, one column per boat and their mean: MAE in m/s, the best of each column bold."""
    table = Table(title="The fleet: MAE in m/s", title_justify="left")
    columns = {boat: {name: row["mae"] for name, row in rows.items()} for boat, rows in boats.items()}
    columns["mean"] = mean_mae(boats)
    table.add_column("estimator")
    for boat in columns:
        table.add_column(boat, justify="right")
    for name in columns["mean"]:
        cells = [
            f"[bold]{maes[name]:.4f}[/]" if maes[name] == min(maes.values()) else f"{maes[name]:.4f}"
            for maes in columns.values()
        ]
        table.add_row(name, *cells)
    return table


def rejection_table(rejected: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Table | None:
    """One row per boat, channel and cause; None where nothing was rejected."""
    table = Table(title="Rejected messages, and steps without a fresh message (stale)", title_justify="left")
    for column in ("boat", "channel", "cause"):
        table.add_column(column)
    table.add_column("count", justify="right")
    for boat, channels in rejected.items():
        for channel, causes in channels.items():
            for cause, count in causes.items():
                table.add_row(boat, channel, cause, str(count))
    return table if table.row_count else None


def sweep_table(jobs: Sequence[tuple[str, Mapping]]) -> Table:
    """One row per job of a sweep, the best first: its overrides, and the MAE of each estimator, mean over boats."""
    done = [(name, result) for name, result in jobs if "boats" in result]
    failed = [(name, result.get("error", "did not finish")) for name, result in jobs if "boats" not in result]
    names = list(dict.fromkeys(n for _, r in done for rows in r["boats"].values() for n in rows))
    table = Table(title="Sweep: MAE in m/s, mean over boats, best job first", title_justify="left")
    table.add_column("job")
    for name in names:
        table.add_column(name, justify="right")
    for job, result in sorted(done, key=lambda item: item[1]["objective"]):
        maes = mean_mae(result["boats"])
        table.add_row(job, *(f"{maes[name]:.4f}" if name in maes else "–" for name in names))
    for job, reason in failed:
        table.add_row(job, f"failed: {reason}", style="red")
    return table
