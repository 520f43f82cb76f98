"""Events: when a thruster lost thrust or recovered, and when a boat changed."""

from __future__ import annotations

from collections.abc import Sequence

from usvlearn.core.events import event_of
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.evaluation.diagnostics import events
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import course_of, event_figure

MOST = 8  # figures


def events_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """The events of all boats, and a figure of the first one of each; None if there were none."""
    here: list[str] = []
    rows: list[tuple] = []
    drawn: list[Drawn] = []
    for season in seasons:
        fleet, published = season.replayed
        seen = events(fleet, published, ensemble.accommodated)[season.boat]
        here += [
            f"{season.boat}, {each['run']}, {each['time'] / 60:.1f} min: {event_of(each).sentence}." for each in seen
        ]
        columns = ("run", "time", "kind", "side", "effectiveness", "low", "high", "given")
        rows += [(season.boat, *(each[key] for key in columns), ", ".join(each["filters"])) for each in seen]
        if seen and len(drawn) < MOST:
            drawn.append(_drawn(season, ensemble, seen))
    if not rows:
        return None
    heads = ("boat", "run", "time, s", "event", "side", "effectiveness", "from", "to", "given after, s", "filters")
    return Section("events", "Events: what changed", "", here, drawn, [ResultTable("events", heads, rows)])


def _drawn(season: Season, ensemble: Ensemble, seen: Sequence[dict]) -> Drawn:
    """The figure of a boat's first event."""
    name = seen[0]["run"]
    run = next(each for each in season.runs if each.name == name and each.published)
    surge = run.measured
    course = course_of(ensemble.names, ensemble.output, run.time, run.samples.inputs, surge, run.published)
    marks = [(each["time"], each["kind"]) for each in seen if each["run"] == name]
    caption = (
        f"{season.boat}, {name}: the first event. Shaded: 90 % intervals of the share of its thrust that each thruster "
        "gives. The evidence of a loss raises an alarm at the threshold."
    )
    return Drawn(
        f"events_{season.boat}", event_figure(course, THRESHOLD, marks, None, f"{season.boat}, {name}"), caption
    )
