"""The summary at the top of a report, and the place of its viewer, in HTML. Names of logs are escaped."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import LOSS, event_of
from usvlearn.core.samples import tree_map
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified, shown
from usvlearn.evaluation.diagnostics import events, identified_boats
from usvlearn.evaluation.free_simulation import FreeRun
from usvlearn.evaluation.horizons import ensemble_scores
from usvlearn.evaluation.metrics import PERSISTENCE, scores
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.report.best_minutes import BestMinutes, best_minutes
from usvlearn.report.summary import displayed, known, undetermined
from usvlearn.report.tables import number
from usvlearn.report.viewer import runs_html

MAIN = {  # the quantities that are shown first, in words
    "steady_speed_full": "Steady speed at full ahead",
    "thrust_full_left": "Full thrust ahead of the left side",
    "thrust_full_right": "Full thrust ahead of the right side",
    "drag_half_speed": "Drag at half of that speed",
    "time_constant": "Time constant",
    "stopping_distance": "Stopping distance with thrusters off",
    "mass": "Mass",
}
TURNS = {"yaw_rate_full": "Yaw rate, outer side full, inner half", "turning_radius_full": "Radius of that turn"}


class Ahead(NamedTuple):
    """Errors of the ensemble over one horizon."""

    what: str
    mae: float | None  # m/s
    skill: float | None
    coverage: float | None  # of the 90 % interval


class RunRow(NamedTuple):
    """A run in numbers."""

    name: str
    minutes: float  # in which the speed was measured
    speed: float | None  # m/s, the mean
    mae: float | None  # m/s, one step ahead
    free: float | None  # m/s, in an open-loop simulation
    learned: bool  # whether the open-loop simulation's parameters have learned from it


class Overview(NamedTuple):
    """One boat."""

    boat: str
    hours: float  # in which the speed was measured
    runs: Sequence[RunRow]
    identified: Identified | None
    ahead: Sequence[Ahead]  # the next step first; empty if no run was replayed
    free: float | None  # m/s, MAE of the open-loop simulations with parameters that have not learned from them
    fit: float | None  # percent, one step ahead (`usvlearn.evaluation.metrics.fit`)
    free_fit: float | None  # percent, of the same open-loop simulations
    events: Sequence[Mapping[str, Any]] | None  # None if nobody watched
    findings: Sequence[Mapping[str, Any]] | None  # of the data check; None if there was none
    batch: Mapping[str, Quantity] | None = None  # the quantities of a batch fit, if there is one
    doubted: bool = False  # whether something speaks against their use
    best: BestMinutes | None = None  # of the open-loop simulations

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """Those to be used: of the batch fit, else learned online."""
        if self.batch is not None and not self.doubted:
            return self.batch
        return {} if self.identified is None else displayed(self.identified)


def overviews(
    ensemble: Ensemble, seasons: Sequence[Season], free: Mapping[str, Sequence[FreeRun]], checks: Sequence[Any] = ()
) -> list[Overview]:
    """What is said of each boat."""
    checks = [check for check in checks if isinstance(check, list)]
    findings = [each for check in checks for each in check if isinstance(each, Mapping)]
    return [
        _overview(
            ensemble,
            season,
            free[season.boat],
            [each for each in findings if each.get("boat") in (None, "", season.boat)] if checks else None,
        )
        for season in seasons
    ]


def _overview(
    ensemble: Ensemble, season: Season, free: Sequence[FreeRun], findings: Sequence[Mapping[str, Any]] | None
) -> Overview:
    column = ensemble.names.index(ensemble.output)
    rows = [_row(run, free_run, column) for run, free_run in zip(season.runs, free, strict=True)]
    unseen = [(row.free, int(run.steps.sum())) for run, row in zip(season.runs, rows, strict=True) if not row.learned]
    total = sum(steps for error, steps in unseen if error is not None)
    ahead, fit = _ahead(ensemble, season)
    fleet, published = season.replayed
    watched = [each for each in published if np.isfinite(each[2].get("thrusters", np.nan)).any()]
    last = tree_map(lambda leaf: leaf[-1:], season.state)
    return Overview(
        season.boat,
        sum(row.minutes for row in rows) / 60,
        rows,
        identified_boats(ensemble, last, [season.boat]).get(season.boat),
        ahead,
        sum(error * steps for error, steps in unseen if error is not None) / total if total else None,
        fit,
        _free_fit(season, free, column),
        events(fleet, published, ensemble.accommodated)[season.boat] if watched else None,
        findings,
        best=best_minutes(season.runs, free, column),
    )


def _row(run: SeasonRun, free: FreeRun, column: int) -> RunRow:
    steps = run.steps
    surge = run.samples.surge[steps]
    predicted = run.published["predictions"][steps, column] if run.published else np.full(len(surge), np.nan)
    return RunRow(
        run.name,
        float(run.samples.inputs.dt[steps].sum()) / 60,
        _mean(surge),
        _mean(np.abs(predicted - surge)),
        _mean(np.abs(free.predictions[steps, column] - surge)),
        free.learned,
    )


def _mean(x: np.ndarray) -> float | None:
    """None where there is no number, or one is unknown."""
    return float(x.mean()) if len(x) and np.isfinite(x).all() else None


def _free_fit(season: Season, free: Sequence[FreeRun], column: int) -> float | None:
    """The fit of the open-loop simulations whose parameters have not learned from them; None without."""
    unseen = [(run, free_run) for run, free_run in zip(season.runs, free, strict=True) if not free_run.learned]
    predictions = [free_run.predictions[run.steps, column] for run, free_run in unseen]
    if not sum(map(len, predictions)):
        return None
    surge = np.concatenate([run.samples.surge[run.steps] for run, _ in unseen])
    fit = scores(np.concatenate(predictions)[:, None], surge, ["free"])["free"]["fit"]
    return None if fit is None else float(fit)


def _ahead(ensemble: Ensemble, season: Season) -> tuple[list[Ahead], float | None]:
    """The errors one step ahead, and of the forecasts, if runs were replayed; the fit one step ahead."""
    runs = [run for run in season.runs if run.published]
    if not runs:
        return [], None
    names = list(dict.fromkeys(name for name in (PERSISTENCE, ensemble.output) if name in ensemble.names))
    places = [ensemble.names.index(name) for name in names]
    predictions = np.concatenate([run.published["predictions"][:, places] for run in runs])
    surge = np.concatenate([run.measured for run in runs])
    widths = [run.published["halfwidths"][:, places] for run in runs if "halfwidths" in run.published]
    row = scores(predictions, surge, names, np.concatenate(widths) if len(widths) == len(runs) else None)[names[-1]]
    errors = [Ahead("the next step", row["mae"], row["skill"], row.get("coverage"))]
    replayed = season._replace(runs=tuple(run for run in runs if "forecasts" in run.published))
    if replayed.runs:
        ahead = ensemble_scores(ensemble, *replayed.replayed).get(season.boat, {}).get(ensemble.output, {})
        errors += [Ahead(f"{h} s", row["mae"], row["skill"], row.get("covers")) for h, row in ahead.items()]
    return errors, row["fit"]


NEAR = "10 s"  # the horizon of the sentence, if it was forecast
FINDING, WARNING = ("about", "found", "expected", "key"), "warning"  # of the data check (`results.json`)
UNSEEN = '<td class="words" colspan="3">not known: no parameters were saved before the run; learn from two logs</td>'
BAD = ' class="bad"'
SIMPLE = "assuming that the speed stays as it is"


class Front(NamedTuple):
    """What stands before the sections of a report."""

    boats: Sequence[Overview]
    viewer: Mapping[str, Any]  # `usvlearn.report.viewer`
    notes: Sequence[str] = ()  # what a reader must know first, a sentence each
    unconfirmed: Sequence[str] = ()  # what was guessed (`usvlearn.core.unconfirmed`)


def title(front: Front) -> str:
    """The report's title: the boat, or how many there are."""
    boats = front.boats
    return f"{boats[0].boat}: what was learned" if len(boats) == 1 else f"{len(boats)} boats: what was learned"


def first_page(front: Front, links: str, drawings: Mapping[str, str] | None = None) -> str:
    """The picture and the cards of a boat, or a table of several boats and then those of each; and the runs.

    `drawings` has the SVG of each boat's best minutes, by its name.
    """
    boats = front.boats
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in (*front.unconfirmed, *front.notes))
    if len(boats) == 1:
        return "\n".join([notes, _cards(boats[0], front, drawings or {}), links, runs_html(boats, front.viewer)])
    cards = (
        f'<details class="part"><summary><h2>{escape(boat.boat)}</h2></summary><div id="boat-{k}">'
        f"{_cards(boat, front, drawings or {})}</div></details>"
        for k, boat in enumerate(boats)
    )
    return "\n".join([notes, _fleet(boats), links, *cards, runs_html(boats, front.viewer)])


def _fleet(boats: Sequence[Overview]) -> str:
    heads = ("boat", "runs", "measured", "error, next step", f"error, {NEAR}", "skill", "in 90 % interval",
             "steady speed at full ahead", "events", "data check")  # fmt: skip
    rows = []
    for k, boat in enumerate(boats):
        near = next((each for each in boat.ahead if each.what == NEAR), None)
        learned = boat.identified.displayed("steady_speed_full") if boat.identified else None
        top = (boat.batch or {}).get("steady_speed_full", learned)
        cells = [
            str(len(boat.runs)),
            _duration(boat.hours),
            number(boat.ahead[0].mae if boat.ahead else None),
            number(near and near.mae),
            number(near and near.skill, 2),
            _share(near and near.coverage),
            f"{shown(top.value)} ({shown(top.low)} to {shown(top.high)}) m/s" if top else "–",
            "–" if boat.events is None else str(len(boat.events)),
            _judged(boat),
        ]
        name = f'<th scope="row"><a href="#boat-{k}">{escape(boat.boat)}</a></th>'
        rows.append(f"<tr>{name}{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
    head = "".join(f"<th>{head}</th>" for head in heads)
    return (
        f'<div class="rows"><table class="fleet"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
        f'</div><p class="facts">Errors are means in m/s; skill and interval {NEAR} ahead.</p>'
    )


def _judged(boat: Overview) -> str:
    """The data check in a few words."""
    if boat.identified is not None and boat.identified.unphysical:
        return "not a physical boat"
    if boat.findings is None:
        return "–"
    return f"{len(boat.findings) or 'no'} finding{'s' * (len(boat.findings) != 1)}"


def _cards(boat: Overview, front: Front, drawings: Mapping[str, str]) -> str:
    wrong = boat.findings or (boat.identified is not None and boat.identified.unphysical)
    good = "" if front.unconfirmed or wrong else ' class="good"'
    cards = (
        (("What was identified", _identified(boat)), ("Data check", _findings(boat, good))),
        (("How well it predicts the speed", _accuracy(boat)), ("Events", _events(boat, good))),
    )
    runs = "1 run" if len(boat.runs) == 1 else f"{len(boat.runs)} runs"
    who = f'<p class="facts">{runs}, {_duration(boat.hours)} of measured speed.</p>'
    inner = "".join(
        "<div>" + "".join(f'<div class="card"><h3>{name}</h3>{body}</div>' for name, body in column) + "</div>"
        for column in cards
    )
    picture = ""
    if boat.best is not None and boat.boat in drawings:
        fits = (
            (boat.best.fit, "here"),
            (boat.free_fit, "of all runs that it has not learned"),
            (boat.fit, "one step ahead"),
        )
        rest = ", ".join(f"{x:.0f} % {how}" for x, how in fits if x is not None)
        said = escape(f"{boat.best.caption}{f' Fit, 100 (1 − NRMSE): {rest}.' if rest else ''}")
        picture = f'<figure><div class="wide">{drawings[boat.boat]}</div><figcaption>{said}</figcaption></figure>'
    return f'{who}{picture}<div class="cards">{inner}</div>'


def _identified(boat: Overview) -> str:
    """The values of a batch fit, if there is one, before those that were learned online."""
    online = _online(boat)
    if boat.batch is None:
        return online
    wide = [in_words(name) for name in undetermined({boat.boat: boat.batch}, MAIN)]
    unsure = f'<p class="bad">The log does not determine: {", ".join(wide)}.</p>' if wide else ""
    use = "do not use these values before its doubts are settled" if boat.doubted else "use these values"
    return (
        f'<p>Fitted to all missions at once; {use}. <a href="#fit">The batch fit</a></p>{_rows(boat.batch)}'
        f"{unsure}<details><summary>Learned online</summary>{online}</details>"
    )


def _online(boat: Overview) -> str:
    if boat.identified is None:
        return "<p>Nothing: the ensemble has no estimator that reads physical quantities.</p>"
    main = {name: boat.identified.displayed(name) for name in MAIN if name in boat.identified}
    wrong, scale, lacks = boat.identified.unphysical, boat.identified.scale, boat.identified.lacks
    notes = "".join(f"<p>{escape(in_words(each))}</p>" for each in (scale, *lacks) if each and each != wrong)
    warning = f'<p class="bad"><b>{escape(wrong)}</b></p>' if wrong else ""
    return f'{warning}{_rows(main)}<div class="notes">{notes}</div>'


def _rows(quantities: Mapping[str, Quantity]) -> str:
    """A table of the quantities of MAIN."""
    rows = "".join(
        f'<tr><th scope="row">{words}</th><td class="n"><b>{shown(quantity.value)}</b> {escape(quantity.unit)}</td>'
        f'<td class="n">{shown(quantity.low)} to {shown(quantity.high)}</td></tr>'
        for name, words in (MAIN | TURNS).items()
        if (quantity := quantities.get(name)) and (name in MAIN or known(quantity))
    )
    head = '<thead><tr><th></th><th class="n">value</th><th class="n">90 % interval</th></tr></thead>'
    return f"<table>{head}<tbody>{rows}</tbody></table>"


def in_words(sentence: str) -> str:
    """A sentence about quantities, with their names as on the first page."""
    for name, words in MAIN.items():
        sentence = sentence.replace(name, words[0].lower() + words[1:]) if "_" in name else sentence
    return re.sub(r"\b[a-z]+(_[a-z]+)+\b", lambda name: name[0].replace("_", " "), sentence)


def _near(boat: Overview) -> Ahead | None:
    """The errors at NEAR, or else at the longest horizon that is judged."""
    errors = {each.what: each for each in boat.ahead if each.mae is not None}
    return errors.get(NEAR) or next(iter(reversed(errors.values())), None)


def _accuracy(boat: Overview) -> str:
    if not boat.ahead and boat.free is None:
        return "<p>Unknown: these runs were not replayed in the folders, so that they have no predictions.</p>"
    said, near = "", _near(boat)
    if near is not None and near.mae is not None:
        ahead = near.what if near.what[0].isdigit() else "One step"
        said = f"<p>{ahead} ahead it errs by <b>{number(near.mae)} m/s</b> on average"
        if near.skill is not None:
            how = f"{abs(near.skill):.0%} {'less' if near.skill >= 0 else 'more'}".replace("%", " %")
            said += f", {how} than by {SIMPLE}"
        said += ".</p>"
    rows = "".join(
        f'<tr><th scope="row">{escape(each.what)}</th><td class="n">{number(each.mae)}</td>'
        f'<td class="n">{number(each.skill, 2)}</td><td class="n">{_share(each.coverage)}</td></tr>'
        for each in boat.ahead
    )
    value = f'<td class="n">{number(boat.free)}</td><td></td><td></td>'
    free = f'<tr><th scope="row">a whole run</th>{UNSEEN if boat.free is None else value}</tr>'
    fits = ((boat.fit, "one step ahead"), (boat.free_fit, "for whole runs"))
    shown = ", ".join(f"{x:.1f} % {how}" for x, how in fits if x is not None)
    fit = f" Fit, 100 (1 − NRMSE): {shown}." if shown else ""
    head = "".join(f'<th class="n">{each}</th>' for each in ("mean error, m/s", "skill", "in the 90 % interval"))
    return (
        f"{said}<table><thead><tr><th>ahead</th>{head}</tr></thead><tbody>{rows}{free}</tbody></table>"
        f'<div class="notes"><p>Skill: 1 is perfect, 0 is no better than {SIMPLE}. A whole run is simulated from the '
        f"commands alone, with parameters that were saved before it.{fit}</p></div>"
    )


def _events(boat: Overview, good: str) -> str:
    if boat.events is None:
        return "<p>Nobody watched the thrusters in these runs.</p>"
    if not boat.events:
        return f"<p{good}>None: no thruster seemed to lose thrust, and the boat did not change.</p>"
    items = "".join(
        f"<li{BAD if each['kind'] == LOSS else ''}>{escape(str(each['run']))}, "
        f"{each['time'] / 60:.1f} min: {escape(event_of(each).sentence)}.</li>"
        for each in boat.events
    )
    return f"<ul>{items}</ul>"


def _findings(boat: Overview, good: str) -> str:
    wrong = boat.identified.unphysical if boat.identified is not None else ""
    learned = f'<p class="bad">{escape(wrong)}</p>' if wrong else ""
    if boat.findings is None:
        return f"{learned}<p>Not made in these runs.</p>"
    if not boat.findings and wrong:
        return f"{learned}<p>The check of the log before the run found nothing.</p>"
    if not boat.findings:
        caveat = "" if good else " But it does not prove what was guessed: see above."
        return f"<p{good}>Nothing suspicious was found in the log.{caveat}</p>"
    items = []
    for each in sorted(boat.findings, key=lambda each: each.get("severity") != WARNING):
        about, value, expected, key = (escape(str(each.get(name) or "")) for name in FINDING)
        wanted = f", expected {expected}" if expected else ""
        fix = f" Set <code>{key}</code>." if key else ""
        style = ' class="bad"' if each.get("severity") == WARNING else ""
        items.append(f"<li{style}><b>{about}</b>: found {value}{wanted}.{fix}</li>")
    return f"{learned}<ul>{''.join(items)}</ul>"


def _duration(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


def _share(value: float | None) -> str:
    return "–" if value is None or value != value else f"{100 * value:.0f} %"
