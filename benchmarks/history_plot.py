"""The figure of the history: timed figures over their first entry, run by run."""

from collections.abc import Sequence

import speed_plots
from history import Entry, Run
from matplotlib.figure import Figure


def over_time(entries: Sequence[Entry], run: Run) -> Figure | None:
    """Timed figures of the run's machine and effort; None where fewer than two runs have any."""
    own = [
        (each.run.date, each.figure)
        for each in entries
        if each.figure.spread is not None and (each.run.machine, each.run.effort) == (run.machine, run.effort)
    ]
    dates = sorted({date for date, _ in own})
    if len(dates) < 2:
        return None
    lines: dict[tuple[str, str], dict[int, float]] = {}
    for date, figure in own:
        lines.setdefault((figure.name, figure.reference), {})[dates.index(date)] = figure.value
    drawn = Figure((speed_plots.WIDTH, 1.2 + 0.19 * len(lines)), layout="constrained")
    axes = drawn.subplots()
    for k, ((name, _), by_run) in enumerate(sorted(lines.items())):
        first = by_run[min(by_run)]
        relative = [value / first for value in by_run.values()]
        style = ("-", "--", ":")[k // 10 % 3]
        axes.plot(list(by_run), relative, style, color=f"C{k % 10}", marker="o", ms=3, lw=1, label=name)
    axes.axhline(1, color="gray", lw=0.5)
    axes.set(ylabel="over the first entry", xlim=(-0.2, len(dates) - 0.8))
    axes.set_xticks(range(len(dates)), [date[:10] for date in dates], rotation=30, ha="right")
    axes.grid(axis="y", alpha=0.25)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=7)
    return drawn
