"""The summary at the top of a report, and the place of its viewer, in HTML. Names of logs are escaped."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

from usvlearn.core.events import LOSS, event_of
from usvlearn.estimators.joint.excitation_warnings import WIDE, Quantity
from usvlearn.estimators.joint.periodic_estimates import shown
from usvlearn.report.overview import MAIN, Ahead, Overview

NEAR = "10 s"  # the horizon of the sentence, if it was forecast
FINDING, WARNING = ("about", "found", "expected", "key"), "warning"  # of the data check (`results.json`)
UNSEEN = '<td class="words" colspan="3">not known: no parameters were saved before the run; learn from two logs</td>'
BAD = ' class="bad"'
SIMPLE = "assuming that the speed stays as it is"


class Front(NamedTuple):
    """What stands before the sections of a report."""

    boats: Sequence[Overview]
    viewer: Mapping[str, Any]  # `usvlearn.report.viewer_data`
    notes: Sequence[str] = ()  # what a reader must know first, a sentence each
    unconfirmed: Sequence[str] = ()  # what was guessed (`usvlearn.core.unconfirmed`)


def title(front: Front) -> str:
    """The report's title: the boat, or how many there are."""
    boats = front.boats
    return f"{boats[0].boat}: what was learned" if len(boats) == 1 else f"{len(boats)} boats: what was learned"


def first_page(front: Front, links: str) -> str:
    """The cards of a boat, or a table of several boats and then the cards of each; and the runs.

    Args:
        front: what is shown.
        links: to the sections.
    """
    boats = front.boats
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in (*front.unconfirmed, *front.notes))
    if len(boats) == 1:
        return "\n".join([notes, _cards(boats[0], front), links, _runs(front)])
    cards = (
        f'<details class="part"><summary><h2>{escape(boat.boat)}</h2></summary><div id="boat-{k}">'
        f"{_cards(boat, front)}</div></details>"
        for k, boat in enumerate(boats)
    )
    return "\n".join([notes, _fleet(boats), links, *cards, _runs(front)])


def _fleet(boats: Sequence[Overview]) -> str:
    heads = ("boat", "runs", "measured", "error, next step", f"error, {NEAR}", "skill", "in 90 % interval",
             "steady speed at full ahead", "events", "data check")  # fmt: skip
    rows = []
    for k, boat in enumerate(boats):
        near = next((each for each in boat.ahead if each.what == NEAR), None)
        own = boat.identified.displayed("steady_speed_full") if boat.identified else None
        top = (boat.batch or {}).get("steady_speed_full", own)
        cells = [
            str(len(boat.runs)),
            _duration(boat.hours),
            _number(boat.ahead[0].mae if boat.ahead else None),
            _number(near and near.mae),
            _number(near and near.skill, 2),
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


def _cards(boat: Overview, front: Front) -> str:
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
    return f'{who}<div class="cards">{inner}</div>'


def _identified(boat: Overview) -> str:
    """The values of a batch fit, if there is one, before those that were learned online."""
    online = _online(boat)
    if boat.batch is None:
        return online
    wide = [words[0].lower() + words[1:] for name, words in MAIN.items() if _is_wide(boat.batch.get(name))]
    unsure = f'<p class="bad">The log does not determine: {", ".join(wide)}.</p>' if wide else ""
    use = "do not use these values before its doubts are settled" if boat.doubted else "use these values"
    return (
        f'<p>Fitted to all missions at once; {use}. <a href="#fit">The batch fit</a></p>{_rows(boat.batch)}'
        f"{unsure}<details><summary>Learned online</summary>{online}</details>"
    )


def _is_wide(found: Quantity | None) -> bool:
    return found is not None and not found.high - found.low <= 2 * WIDE * abs(found.value)


def _online(boat: Overview) -> str:
    if boat.identified is None:
        return "<p>Nothing: the ensemble has no estimator that reads physical quantities.</p>"
    found = {name: boat.identified.displayed(name) for name in MAIN if name in boat.identified}
    wrong, scale, lacks = boat.identified.unphysical, boat.identified.scale, boat.identified.lacks
    notes = "".join(f"<p>{escape(in_words(each))}</p>" for each in (scale, *lacks) if each and each != wrong)
    warning = f'<p class="bad"><b>{escape(wrong)}</b></p>' if wrong else ""
    return f'{warning}{_rows(found)}<div class="notes">{notes}</div>'


def _rows(quantities: Mapping[str, Quantity]) -> str:
    """A table of the quantities of MAIN."""
    rows = "".join(
        f'<tr><th scope="row">{words}</th><td class="n"><b>{shown(found.value)}</b> {escape(found.unit)}</td>'
        f'<td class="n">{shown(found.low)} to {shown(found.high)}</td></tr>'
        for name, words in MAIN.items()
        if (found := quantities.get(name))
    )
    head = '<thead><tr><th></th><th class="n">value</th><th class="n">90 % interval</th></tr></thead>'
    return f"<table>{head}<tbody>{rows}</tbody></table>"


def in_words(sentence: str) -> str:
    """A sentence about quantities, with their names as on the first page.

    >>> in_words("Not well determined: drag_half_speed, thrust_ratio.")
    'Not well determined: drag at half of that speed, thrust ratio.'
    """
    for name, words in MAIN.items():
        sentence = sentence.replace(name, words[0].lower() + words[1:]) if "_" in name else sentence
    return re.sub(r"\b[a-z]+(_[a-z]+)+\b", lambda name: name[0].replace("_", " "), sentence)


def _near(boat: Overview) -> Ahead | None:
    """The errors at NEAR, or else at the longest horizon that is judged."""
    known = {each.what: each for each in boat.ahead if each.mae is not None}
    return known.get(NEAR) or next(iter(reversed(known.values())), None)


def _accuracy(boat: Overview) -> str:
    if not boat.ahead and boat.free is None:
        return "<p>Unknown: these runs were not replayed in the folders, so that they have no predictions.</p>"
    said, near = "", _near(boat)
    if near is not None and near.mae is not None:
        ahead = near.what if near.what[0].isdigit() else "One step"
        said = f"<p>{ahead} ahead it errs by <b>{_number(near.mae)} m/s</b> on average"
        if near.skill is not None:
            how = f"{abs(near.skill):.0%} {'less' if near.skill >= 0 else 'more'}".replace("%", " %")
            said += f", {how} than by {SIMPLE}"
        said += ".</p>"
    rows = "".join(
        f'<tr><th scope="row">{escape(each.what)}</th><td class="n">{_number(each.mae)}</td>'
        f'<td class="n">{_number(each.skill, 2)}</td><td class="n">{_share(each.coverage)}</td></tr>'
        for each in boat.ahead
    )
    known = f'<td class="n">{_number(boat.free)}</td><td></td><td></td>'
    free = f'<tr><th scope="row">a whole run</th>{UNSEEN if boat.free is None else known}</tr>'
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
        told = "" if good else " But it does not prove what was guessed: see above."
        return f"<p{good}>Nothing suspicious was found in the log.{told}</p>"
    items = []
    for each in sorted(boat.findings, key=lambda each: each.get("severity") != WARNING):
        about, found, expected, key = (escape(str(each.get(name) or "")) for name in FINDING)
        wanted = f", expected {expected}" if expected else ""
        fix = f" Set <code>{key}</code>." if key else ""
        style = ' class="bad"' if each.get("severity") == WARNING else ""
        items.append(f"<li{style}><b>{about}</b>: found {found}{wanted}.{fix}</li>")
    return f"{learned}<ul>{''.join(items)}</ul>"


def _duration(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


def _number(value: float | None, digits: int = 3) -> str:
    return "–" if value is None or value != value else f"{value:.{digits}f}"


def _share(value: float | None) -> str:
    return "–" if value is None or value != value else f"{100 * value:.0f} %"


def _runs(front: Front) -> str:
    """A table, and the place where the viewer is drawn."""
    several = len(front.boats) > 1
    places, rows, options = iter(range(len(front.viewer["runs"]))), [], ""
    for boat in front.boats:
        options += f'<optgroup label="{escape(boat.boat)}">'
        for run in boat.runs:
            place = next(places)
            options += f'<option value="{place}">{escape(f"{boat.boat}, {run.name}" if several else run.name)}</option>'
            free = _number(run.free) + ("*" if run.learned and run.free is not None else "")
            cells = (f"{run.minutes:.1f}", _number(run.speed, 2), _number(run.mae), free)
            name = f'<a href="#viewer" data-run="{place}">{escape(run.name).replace("_", "_<wbr>")}</a>'
            whose = f"<td>{escape(boat.boat)}</td>" if several else ""
            numbers = "".join(f'<td class="n">{cell}</td>' for cell in cells)
            rows.append(f'<tr><th scope="row">{name}</th>{whose}{numbers}</tr>')
        options += "</optgroup>"
    heads = "".join(
        f'<th class="n">{each}</th>'
        for each in ("measured, min", "mean speed, m/s", "error, next step, m/s", "error, open-loop simulation, m/s")
    )
    colours = front.viewer["colours"]
    names = "".join(
        f'<label><input type="checkbox"{"" if name in front.viewer["hidden"] else " checked"} value="{escape(name)}">'
        f"{_chip(colours[name])}{escape(name)}</label>"
        for name in front.viewer["shown"]
    )
    sides = "".join(f"<span>{_chip(colour)}{side}</span>" for side, colour in front.viewer["sides"].items())
    return f"""<section id="runs"><h2>Run by run</h2>
<div class="rows"><table class="runs"><thead><tr><th>run</th>{"<th>boat</th>" if several else ""}{heads}</tr></thead>
<tbody>{"".join(rows)}</tbody></table></div>
<p class="facts">An open-loop simulation is simulated from the commands alone. * Its parameters have learned from this
run.</p> <noscript><p>The curves of the runs need JavaScript.</p></noscript> <div
id="viewer" hidden> <form class="tools" autocomplete="off"> <label>Run <select
id="viewer-run">{options}</select></label> <label>beside it <select id="viewer-beside"><option
value="">none</option>{options}</select></label> <label>Errors of <select id="viewer-error"><option value="error">the
next step</option> <option value="free error">an open-loop simulation</option></select></label> <button type="button"
id="viewer-reset">Reset the zoom</button> <span
id="viewer-names"><span>{_chip("var(--ink)")}measured</span>{names}{sides}</span></form> <p class="facts">Drag, scroll
or pinch to move and zoom. Keys: arrows, + and −, 0 for the whole run. The shaded band is the 90 % interval.</p><div
id="viewer-columns"></div> <p class="facts">Size of the error on the tracks: 0 <span class="scale"></span> <span
id="viewer-largest"></span>. The tracks and the axes of two runs have one scale. Errors are predicted − measured: lines
are means, bands 90 % of them.</p></div>
<script type="application/json" id="viewer-data">{embedded(front.viewer)}</script></section>"""


def _chip(colour: str) -> str:
    return f'<span class="chip" style="background: {colour}"></span>'


def embedded(data: Any) -> str:
    """JSON that a page can contain between its tags, whatever the names in it.

    >>> embedded({"boat": "</script><!--"})
    '{"boat":"\\\\u003c/script\\\\u003e\\\\u003c!--"}'
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")
