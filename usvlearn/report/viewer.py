"""The viewer in a page, and its numbers: each run's measured, predicted and free speed, commands, errors and track.

A series is 16-bit integers as base64 beside its least value and its step, so that a number is known to half a step:

    x = low + step (k + 32767),   k = −32768 where it is unknown                                       (1)

A page holds at most BUDGET numbers. Where there are more, the steps are put into buckets of equal length. A bucket has
two numbers of each line, its least and its greatest in the order in which they came, so that no peak is lost; of an
error it has the one with the largest size, and of a position the first.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from usvlearn.display.figures import PAPER, SIDES, colours
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.free_simulation import FreeRun
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.report.tables import number
from usvlearn.report.track_maps import Ahead, BoatTracks

BUDGET = 1_500_000  # numbers; 4 MB in a page
LEVELS = 65534  # of a series
BINS, FEWEST = 14, 5  # of residuals, and steps without which a bin is left out
MOST_MEMBERS = 4  # of those that the output weighs
NEAR = 1.2  # s between two points of a forecast track
LOGGED = "Positions as logged."
RECKONED = "The log has no positions: the track is reckoned from the measured speed and the heading, so that it drifts."


def viewer_data(
    ensemble: Ensemble,
    seasons: Sequence[Season],
    free: Mapping[str, Sequence[FreeRun]],
    tracks: Mapping[str, BoatTracks] | None = None,
) -> dict[str, Any]:
    """All that the viewer shows, for JSON."""
    weighed = [*ensemble.weighed[:MOST_MEMBERS], ensemble.output]
    hidden = [name for name in PAPER if name in ensemble.names and name not in weighed]
    shown = [*hidden, *weighed]
    columns = [ensemble.names.index(name) for name in shown]
    steps = sum(len(run.time) for season in seasons for run in season.runs)
    total = steps * (8 + 2 * len(shown))
    size = 1 if total <= BUDGET else -(-2 * total // BUDGET)
    runs = [
        {"boat": season.boat, "name": run.name} | _run(run, sim, shown, columns, size, (tracks or {}).get(season.boat))
        for season in seasons
        for run, sim in zip(season.runs, free[season.boat], strict=True)
    ]
    about = {"output": ensemble.output, "shown": shown, "hidden": hidden, "colours": colours(shown), "sides": SIDES}
    return {**about, "runs": runs}


def _run(
    run: SeasonRun, free: FreeRun, shown: Sequence[str], columns: Sequence[int], size: int, tracks: BoatTracks | None
) -> dict[str, Any]:
    known = run.masks
    surge = np.where(run.samples.measured & known.known, run.samples.surge, np.nan)
    counted = run.measured
    left, right, *_ = (np.where(run.samples.fresh, x, np.nan) for x in run.samples.inputs)
    lines = {"measured": surge, "left": left, "right": right}
    largest = {"free error": free.predictions[:, columns[-1]] - counted}
    lines |= {f"free {name}": free.predictions[:, k] for name, k in zip(shown, columns, strict=True)}
    if run.published:
        predicted = run.published["predictions"]
        largest["error"] = predicted[:, columns[-1]] - counted
        lines |= {f"next {name}": predicted[:, k] for name, k in zip(shown, columns, strict=True)}
        if "halfwidths" in run.published:
            largest["halfwidth"] = run.published["halfwidths"][:, columns[-1]]
    track = reckoned(run) if run.position is None else run.position
    series = {name: coded(extremes(line, size)) for name, line in lines.items()}
    series |= {name: coded(largest_of(line, size)) for name, line in largest.items()}
    series |= {name: coded(track[::size, k]) for k, name in enumerate(("north", "east"))}
    bins = {
        f"{name} against {beside}": residuals(x, largest[name])
        for name in ("error", "free error")
        for beside, x in (("speed", counted), ("command", (left + right) / 2))
        if name in largest
    }
    return {
        "learned": free.learned,
        "track": RECKONED if run.position is None else LOGGED,
        "width": size * run.spacing,
        "time": base64.b64encode(run.time[::size].astype("<f4").tobytes()).decode(),
        "series": series,
        "bins": bins,
        **_ahead(run, tracks, track),
    }


def _ahead(run: SeasonRun, tracks: BoatTracks | None, path: np.ndarray) -> dict[str, Any]:
    """The tracks that were forecast in this run, from the boat's `path`, m, `(time, 2)`; {} if there are none."""
    mission = None if tracks is None else tracks.mission
    if mission is None or mission.run.key != run.key:
        return {}
    known = [each for each in mission.ahead if np.isfinite(path[each.step]).all()]
    return {"ahead": [_track(each, float(run.time[each.step]), path[each.step]) for each in known]}


def _track(each: Ahead, time: float, origin: np.ndarray) -> dict[str, Any]:
    """A track, m, with a point at least each NEAR s, and ellipses: horizon, centre's index, semi-axes, bearing."""
    ends, points, last = {ellipse.step for ellipse in each.ellipses} | {len(each.time) - 1}, [], 0.0
    for k, t in enumerate(each.time):
        if k in ends or t - last >= NEAR - 1e-6:
            points.append(k)
            last = t
    ellipses = [
        [ellipse.horizon, 1 + points.index(ellipse.step), *(round(x, 2) for x in ellipse[2:])] for ellipse in each.drawn
    ]
    lines = np.stack([each.north, each.east])[:, points] + origin[:, None]
    north, east = np.concatenate([origin[:, None], lines], 1).round(2).tolist()
    return {"time": round(time, 2), "span": round(float(each.time[-1]), 2), "north": north, "east": east,
            "ellipses": ellipses}  # fmt: skip


def coded(x: np.ndarray) -> list[Any]:
    """A series as (1): base64 of little-endian integers, the least value, and the step."""
    finite = np.isfinite(x)
    low, high = (float(x[finite].min()), float(x[finite].max())) if finite.any() else (0.0, 0.0)
    step = (high - low) / LEVELS
    levels = np.where(finite, np.round((np.where(finite, x, low) - low) / (step or 1.0)) - LEVELS // 2, -32768)
    return [base64.b64encode(levels.astype("<i2").tobytes()).decode(), low, step]


def extremes(x: np.ndarray, size: int) -> np.ndarray:
    """The least and the greatest of each bucket in their order, `(2 · buckets,)`; `x` itself if `size` is 1."""
    if size == 1:
        return x
    whole = _buckets(x, size)
    least = np.where(np.isfinite(whole), whole, np.inf).argmin(1)
    most = np.where(np.isfinite(whole), whole, -np.inf).argmax(1)
    order = np.sort(np.stack([least, most], 1), 1)
    return np.take_along_axis(whole, order, 1).reshape(-1)


def largest_of(x: np.ndarray, size: int) -> np.ndarray:
    """The number of the largest size of each bucket, `(buckets,)`."""
    whole = _buckets(x, size)
    at = np.where(np.isfinite(whole), np.abs(whole), -1.0).argmax(1)
    return np.take_along_axis(whole, at[:, None], 1)[:, 0]


def _buckets(x: np.ndarray, size: int) -> np.ndarray:
    missing = -len(x) % size
    return np.append(x, np.full(missing, np.nan)).reshape(-1, size)


def reckoned(run: SeasonRun) -> np.ndarray:
    """The way from the start by measured speed and heading, m north and east, `(time, 2)`; gaps in the log are no way.

    Where no speed was measured, the boat keeps the last one.
    """
    masks = run.masks
    known = masks.known & run.samples.measured
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    speed = np.where(last >= 0, run.samples.surge[np.maximum(last, 0)], 0.0)
    way, heading = (np.where(masks.steps, x, 0.0) for x in (speed * run.samples.inputs.dt, run.samples.inputs.heading))
    return np.cumsum(way[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1), 0)


def residuals(x: np.ndarray, error: np.ndarray) -> list[list[float]]:
    """Errors against `x` in bins of equal width: middle, mean, 5 % and 95 % quantiles, and the number of steps."""
    both = np.isfinite(x) & np.isfinite(error)
    if not both.any():
        return []
    x, error = x[both], error[both]
    low, width = x.min(), (x.max() - x.min()) / BINS
    place = np.zeros(len(x), int) if width == 0 else np.minimum((x - low) / width, BINS - 1).astype(int)
    bins = []
    for k in range(BINS):
        here = error[place == k]
        if len(here) >= FEWEST:
            middle = low if width == 0 else low + (k + 0.5) * width
            numbers = (middle, here.mean(), *np.percentile(here, (5, 95)))
            bins.append([*(float(f"{each:.4g}") for each in numbers), len(here)])
    return bins


def runs_html(boats: Sequence[Any], viewer: Mapping[str, Any]) -> str:
    """A table of the runs of `usvlearn.report.front.Overview`s, and the place where the viewer is drawn."""
    several = len(boats) > 1
    places, rows, options = iter(range(len(viewer["runs"]))), [], ""
    for boat in boats:
        options += f'<optgroup label="{escape(boat.boat)}">'
        for run in boat.runs:
            place = next(places)
            options += f'<option value="{place}">{escape(f"{boat.boat}, {run.name}" if several else run.name)}</option>'
            free = number(run.free) + ("*" if run.learned and run.free is not None else "")
            cells = (f"{run.minutes:.1f}", number(run.speed, 2), number(run.mae), free)
            name = f'<a href="#viewer" data-run="{place}">{escape(run.name).replace("_", "_<wbr>")}</a>'
            whose = f"<td>{escape(boat.boat)}</td>" if several else ""
            numbers = "".join(f'<td class="n">{cell}</td>' for cell in cells)
            rows.append(f'<tr><th scope="row">{name}</th>{whose}{numbers}</tr>')
        options += "</optgroup>"
    heads = "".join(
        f'<th class="n">{each}</th>'
        for each in ("measured, min", "mean speed, m/s", "error, next step, m/s", "error, open-loop simulation, m/s")
    )
    colours = viewer["colours"]
    names = "".join(
        f'<label><input type="checkbox"{"" if name in viewer["hidden"] else " checked"} value="{escape(name)}">'
        f"{_chip(colours[name])}{escape(name)}</label>"
        for name in viewer["shown"]
    )
    sides = "".join(f"<span>{_chip(colour)}{side}</span>" for side, colour in viewer["sides"].items())
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
<script type="application/json" id="viewer-data">{embedded(viewer)}</script></section>"""


def _chip(colour: str) -> str:
    return f'<span class="chip" style="background: {colour}"></span>'


def embedded(data: Any) -> str:
    """JSON that a page can contain between its tags, whatever the names in it."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")
