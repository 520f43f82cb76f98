"""Forecasts: skill against horizon, per estimator, and the coverage of the intervals."""

from __future__ import annotations

from collections.abc import Sequence

from usvlearn.display.result_table import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.horizons import Scores, ensemble_scores
from usvlearn.evaluation.manoeuvres import GROUPS
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import forecast_figure


def forecast_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """Errors of the forecasts that became due in all runs that were replayed; None of an ensemble without forecasts.

    Args:
        seasons: of all boats.
        ensemble: that was replayed.
    """
    if ensemble.forecasts is None:
        return None
    found: Scores = {}
    for season in seasons:
        found |= _scores(season, ensemble)
    if not found:
        return None
    rows = [
        (
            boat,
            name,
            float(horizon),
            row["mae"],
            row["skill"],
            row.get("covers"),
            *(row.get(f"covers_{x}") for x in GROUPS),
            row.get("halfwidth"),
            row.get("interval"),
            row["steps"],
        )
        for boat, table in found.items()
        for name, each in table.items()
        for horizon, row in each.items()
    ]
    columns = ("boat", "method", "horizon, s", "MAE, m/s", "skill", "coverage of the 90 % interval",
               "where commands stay", "move", "move much", "mean half-width, m/s", "interval score, m/s",
               "forecasts")  # fmt: skip
    caption = (
        "Skill of forecasts, 1 − MAE/MAE(persistence), against the horizon. A forecast is made at its origin, from the "
        "measurements until then, and is given the commands, headings and yaw rates between. Dotted: persistence."
    )
    drawn = [Drawn("forecast", forecast_figure(found), caption)]
    return Section(
        "forecast", "Forecasts", "", _findings(found, ensemble.output), drawn, [ResultTable("forecast", columns, rows)]
    )


def _scores(season: Season, ensemble: Ensemble) -> Scores:
    """The scores of one boat; {} if its forecasts were not kept."""
    runs = [run for run in season.runs if "forecasts" in run.published]
    if not runs:
        return {}
    fleet, published = season._replace(runs=tuple(runs)).replayed
    return ensemble_scores(ensemble, fleet, published)


def _findings(found: Scores, output: str) -> list[str]:
    """What the figure shows, in words."""
    horizons = list(next(iter(found.values()))[output])
    skills = {h: [x for table in found.values() if (x := table[output][h]["skill"]) is not None] for h in horizons}
    shown = ", ".join(f"{sum(each) / len(each):.2f} at {h} s" for h, each in skills.items() if each)
    here = [f"Skill of {output}, mean over boats: {shown}."]
    below = [
        f"{boat} at {h} s" for boat, table in found.items() for h in horizons if (table[output][h]["skill"] or 0.0) < 0
    ]
    here.append(
        f"Worse than persistence: {', '.join(below)}." if below else "Better than persistence wherever it is judged."
    )
    rows = [row for table in found.values() for row in table[output].values()]
    held = [share for row in rows if (share := row.get("covers")) is not None]
    if held:
        here.append(f"The intervals hold {100 * min(held):.0f} … {100 * max(held):.0f} % of the speeds (90 % asked).")
    for group, words in zip(GROUPS, ("stay", "move", "move much"), strict=True):
        if own := [share for row in rows if (share := row.get(f"covers_{group}")) is not None]:
            here.append(f"Where the commands {words}: {100 * min(own):.0f} … {100 * max(own):.0f} %.")
    return here
