"""Residuals: whether the errors one step ahead depend on those before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.display.figures import INK, LINE, colours, guarded, themed
from usvlearn.display.result_table import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.autocorrelation import Autocorrelation, of_runs
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section

LAGS = 25  # steps, the largest
ACROSS = 3  # panels in a row
UNEVEN = 0.05  # relative scatter of the lengths of steps, from which on they are called uneven


def residual_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """The autocorrelation of the errors of the combiner that predicts; None if no run was replayed.

    Args:
        seasons: of all boats.
        ensemble: that was replayed.
    """
    column, found, here, uneven = ensemble.names.index(ensemble.output), {}, [], False
    for season in seasons:
        runs = [run for run in season.runs if run.published]
        if not runs or np.isnan((each := of_runs(runs, column, LAGS)).values[0]):
            continue
        found[season.boat] = each
        beyond = np.abs(each.values) > each.bounds
        here.append(
            f"{season.boat}, {ensemble.output}: {each.values[0]:.2f} at a lag of 1 step; {int(beyond.sum())} of {LAGS} "
            f"lags are beyond ± {each.bounds[0]:.3f}."
        )
        lengths = np.concatenate([run.samples.inputs.dt[run.steps] for run in runs])
        uneven = uneven or bool(lengths.std() > UNEVEN * lengths.mean())
    if not found:
        return None
    here.append(
        "The bounds hold 99 % of the values if errors do not depend on each other. Values beyond them mean that there "
        "is more to learn: waves, gusts, a slow drift. With many steps, small values are beyond them, too."
    )
    if uneven:
        here.append("The steps of these logs are of different lengths: a lag is a number of steps, not a time.")
    caption = (
        f"Autocorrelation of the errors of {ensemble.output} one step ahead, up to {LAGS} steps apart. Pairs are "
        "within a segment of a run; steps that do not count are left out. Shaded: ± 2.58/√N, N the number of pairs."
    )
    rows = [
        (boat, lag, float(value), float(bound), int(pairs))
        for boat, each in found.items()
        for lag, (value, bound, pairs) in enumerate(zip(each.values, each.bounds, each.pairs, strict=True), 1)
    ]
    columns = ("boat", "lag, steps", "autocorrelation", "99 % bound", "pairs")
    drawn = Drawn("residuals", residual_figure(found, ensemble.output), caption)
    table = ResultTable("residuals", columns, rows)
    return Section("residuals", "Residuals: what is left in the errors", "", here, [drawn], [table])


@guarded
def residual_figure(boats: Mapping[str, Autocorrelation], name: str):
    """A panel per boat: the autocorrelation against the lag, and the 99 % bounds.

    Args:
        boats: by name.
        name: of the estimator, for its colour.

    >>> figure = residual_figure({"heron": Autocorrelation(np.array([0.3, 0.1]), np.array([90, 80]))}, "ensemble")
    >>> figure.axes[0].get_xlabel()
    'lag, steps'
    """
    colour, across = colours([name])[name], min(ACROSS, len(boats))
    down = -(-len(boats) // across)
    with themed() as Figure:
        figure = Figure(figsize=(1.2 + 2.9 * across, 0.4 + 1.7 * down), layout="constrained")
        panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).reshape(-1)
        for panel in panels[len(boats) :]:
            panel.set_visible(False)
        for panel, (boat, found) in zip(panels, boats.items(), strict=False):
            lags = np.arange(1, len(found.values) + 1)
            panel.fill_between(lags, -found.bounds, found.bounds, color=INK, alpha=0.14, linewidth=0)
            panel.axhline(0.0, color=INK, linewidth=0.8)
            panel.vlines(lags, 0, found.values, color=colour, linewidth=2)
            panel.plot(lags, found.values, ".", color=colour, markersize=5)
            panel.set_title(boat, loc="left", fontsize=8.5)
            panel.set_xlabel("lag, steps", fontsize=8)
            panel.grid(axis="y", color=LINE)
            panel.tick_params(labelsize=8)
        return figure
