"""Tables for the terminal."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.text import Text

from usvlearn.core.events import LOSS, event_of
from usvlearn.display.terminal import Blocks
from usvlearn.engine.identified import sentences
from usvlearn.estimators.joint.periodic_estimates import Identified, shown
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.evaluation.metrics import PERSISTENCE, by_error, mean
from usvlearn.runs.compared import label

TOGGLE = "Of several boats, the pages IMAGES and TEXT open empty: press TOGGLE ALL RUNS there."
COVERED = {
    "90 % intervals cover": "covers", "while commands are steady": "covers_stay", "changing": "covers_move",
    "changing strongly": "covers_move_much",
}  # fmt: skip
FEW = 4  # events that are shown without --all
TRACKS = {
    "ours, m": "position", "constant turn and speed, m": "position_constant_turn",
    "forecast speed, held yaw rate, m": "position_held_rate",
}  # fmt: skip
COLUMNS = {"mae": "MAE", "median": "median", "rmse": "RMSE", "skill": "skill", "halfwidth": "±", "coverage": "covers",
           "steps": "steps"}  # fmt: skip


def number(value: float | None, digits: int = 3) -> str:
    """A dash where it is unknown."""
    return "–" if value is None or value != value else f"{value:.{digits}f}"


def _cell(column: str, row: Mapping) -> str:
    value = row.get(column)
    if column in ("steps", "diverged"):
        return f"{value:.0f}"
    if column == "coverage":
        return "–" if value is None else f"{value:.1%}"
    return number(value, 3 if column in ("skill", "halfwidth") else 4)


def _name(name: str, remarks: Mapping[str, str] | None) -> str:
    return f"{name}, {remarks[name]}" if remarks and name in remarks else name


def score_table(
    boats: Mapping[str, Mapping[str, Mapping]],
    remarks: Mapping[str, str] | None = None,
    title: str = "One-step prediction of surge, errors in m/s, by MAE",
) -> Blocks:
    """One row per boat and estimator, the best of each boat first: errors in m/s, skill, the interval, steps."""
    failed = any(row.get("diverged") for rows in boats.values() for row in rows.values())
    columns = [*COLUMNS, *(["diverged"] if failed else [])]
    heads = [COLUMNS.get(column, column) for column in columns]
    table = Blocks(title, ["estimator"], heads)
    for boat, rows in boats.items():
        if len(boats) > 1:
            table.group(boat)
        for k, name in enumerate(by_error({name: row["mae"] for name, row in rows.items()})):
            row = rows[name]
            cells = [_cell(column, row) for column in columns]
            table.add(_name(name, remarks), *cells, style="bold" if k == 0 and row["mae"] is not None else "")
    return table


def rejection_table(rejected: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Blocks | None:
    """One row per boat and channel, with the counts by cause; None if nothing was rejected."""
    table = Blocks("Rejected: messages by cause, and stale steps", ["channel", "causes"], folded=["causes"])
    for boat, channels in rejected.items():
        if channels:
            table.group(boat)
        for channel, causes in channels.items():
            table.add(channel, ", ".join(f"{cause} {n}" for cause, n in causes.items()))
    return table if table.rows else None


def forecast_table(
    forecast: Mapping[str, Mapping[str, Mapping[str, Mapping]]], whole: bool = True, means: int = 0
) -> Blocks | None:
    """Skill by horizon: one row per boat and estimator, and the coverage of the ensemble's intervals; None without.
    `means`: of how many boats they are the means.
    """
    if not forecast:
        return None
    horizons = list(next(iter(next(iter(forecast.values())).values())))
    of = f", means of {means} boats" if means else ""
    table = Blocks(f"Forecasts: skill by horizon, s{of} (–: too few, or one was no speed)", ["estimator"], horizons)
    for boat, rows in forecast.items():
        if len(forecast) > 1:
            table.group(boat)
        *others, output = [name for name in rows if name != PERSISTENCE]
        for name in (output, *others):
            cells = [number(rows[name][h]["skill"], 3) for h in horizons]
            table.add(name, *cells, style="bold" if name == output else "")
        for words, key in COVERED.items():  # runs of before have the first alone
            held = [rows[output][h].get(key) for h in horizons]
            if key == "covers" or any(x is not None for x in held):
                table.add(words, *("–" if x is None else f"{x:.0%}" for x in held))
        scores = [rows[output][h].get("interval") for h in horizons]
        if whole and any(x is not None for x in scores):
            table.add("interval score, m/s", *(number(x, 3) for x in scores))
    return table


def track_table(tracks: Mapping[str, Mapping[str, Mapping[str, Any]]] | None) -> Blocks | None:
    """Errors of tracks by horizon, one block for each boat; None where nothing became due."""
    if not tracks or not any(row["count"] for rows in tracks.values() for row in rows.values()):
        return None
    horizons = list(next(iter(tracks.values())))
    table = Blocks("Tracks: mean distance from the boat's position by horizon, s", ["track"], horizons)
    for boat, rows in tracks.items():
        if len(tracks) > 1:
            table.group(boat)
        for words, key in TRACKS.items():
            table.add(words, *(number(rows[h][key], 2) for h in horizons), style="bold" if key == "position" else "")
        turned = [rows[h]["heading"] for h in horizons]
        table.add("heading error, °", *("–" if x is None else f"{math.degrees(x):.1f}" for x in turned))
        held = [rows[h]["inside"] for h in horizons]
        table.add("within the ellipses of 90 %", *("–" if x is None else f"{x:.0%}" for x in held))
    return table


def data_check_table(findings: Sequence[Mapping[str, str]], checks: int = 0) -> Blocks | Text:
    """What the data check found, or one line if that is nothing."""
    if not findings:
        return Text(f"Data check: no findings in {checks} checks\n")
    rows: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for each in findings:
        rows.setdefault((each["severity"], each["about"], each["kind"]), []).append(each)
    table = Blocks("Data check", ["", "finding"], folded=["finding"])
    for (severity, about, _), same in rows.items():
        first, others = same[0], len({each["boat"] for each in same}) - 1
        boats = first["boat"] + (f" and {others} more" if others else "")
        table.add(severity, f"{boats}, {about}: {first['found']}; expected: {first['expected']}",
                  style="bold" if severity == "warning" else "")  # fmt: skip
        if first["key"]:
            table.add("", f"set {first['key']}")
    return table


def error_tables(
    boats: Mapping[str, Mapping[str, Mapping]],
    remarks: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
    forecast: Mapping[str, Any] | None = None,
    main: tuple[str, Collection[str]] | None = None,
) -> Group:
    """The errors of a run, one step and further ahead, and notes on them.

    Given the combiner that predicts and the members, only it, the baseline and the best member are shown, as means.
    """
    boats, forecast, several = _short(boats, main), _short(forecast or {}, main), len(boats) > 1
    title = f"One-step prediction of surge, means of {len(boats)} boats, m/s, by MAE"
    means = score_table({"": averaged(list(boats.values()))}, remarks, title) if several else None
    if main and several:
        forecast = {"": averaged(list(forecast.values()))} if forecast else {}
        return Group(*filter(None, [means, forecast_table(forecast, False, len(boats))]))
    tables = [score_table(boats, remarks), means, forecast_table(forecast, main is None)]
    return Group(*filter(None, tables), *map(Text, () if main else notes))


def _short(boats: Mapping[str, Any], main: tuple[str, Collection[str]] | None) -> Mapping[str, Any]:
    """The rows of the combiner, the baseline and the member with the least error, at the last horizon if there are
    several, mean over boats; other rows are left out.
    """
    if main is None or not boats:
        return boats
    errors: dict[str, float | None] = {}
    for name in set(main[1]) & next(iter(boats.values())).keys() - {PERSISTENCE}:
        rows = [each[name] for each in boats.values()]
        errors[name] = mean((row if "mae" in row else list(row.values())[-1])["mae"] for row in rows)
    shown = {main[0], *by_error(errors)[:1], PERSISTENCE}
    return {boat: {name: row for name, row in each.items() if name in shown} for boat, each in boats.items()}


def averaged(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The means of tables of numbers, or of tables of such, with the same keys; None where one is unknown."""
    return {
        key: averaged([each[key] for each in tables])
        if isinstance(value, Mapping)
        else mean(x.get(key) for x in tables)
        for key, value in tables[0].items()
    }


def event_lines(events: Mapping[str, Sequence[Mapping]], whole: bool = True) -> list[str]:
    """A line for each event, or for the first few, below an empty one."""
    lines = [
        f"{'ALARM' if each['kind'] == LOSS else 'EVENT'}: {boat}, run {each['run']}, {each['time']:.0f} s: "
        f"{event_of(each).sentence}"
        for boat, happened in events.items()
        for each in happened
    ]
    more = [] if whole or len(lines) <= FEW else [f"{len(lines) - FEW} more events: add --all"]
    return ["", *(lines[:FEW] if more else lines), *more]


def identified_table(
    identified: Mapping[str, Identified], truth: Mapping[str, Mapping[str, float]] | None = None, whole: bool = True
) -> Group:
    """Quantities with their 90 % intervals, boat by boat; not `whole`: only what is not determined, or not physical.

    The nine single parameters, which trade against each other, are shown of a single boat; of several boats they are in
    `results.json` and in the report.
    """
    if not identified:
        return Group()
    truth, several = truth or {}, len(identified) > 1
    heads = ["value", "from", "to", *(["truth"] if truth else []), "unit"]
    table = Blocks("Identified, with 90 % intervals", ["quantity"], heads)
    for boat, quantities in identified.items():
        if several:
            table.group(boat)
        known = truth.get(boat, {})
        for name in (name for name in quantities if not (several and name in SURGE)):
            *numbers, unit = quantities.displayed(name)
            true = [shown(known[name]) if name in known else "–"] if truth else []
            table.add(name, *map(shown, numbers), *true, unit)
    more = ["The nine parameters of each boat are in results.json and in the report."] if several else []
    if any(each.unknown for each in identified.values()):
        more.append("–: not known yet; the interval is wider than what such a boat can have.")
    wrong = [f"WARNING: {boat}: {each.unphysical}" for boat, each in identified.items() if each.unphysical]
    stated = [each for each in sentences(identified, whole) if not any(each in one for one in wrong)]
    shown_first: list[Text | Blocks] = [Text(), table, Text(MEANING)] if whole else []
    said = [*stated, *(more if whole else [])]
    return Group(*shown_first, *map(Text, said), *(Text(f"\n{each}", "bold red") for each in wrong))


def short_settings(settings: Mapping[str, str], keys: Sequence[str]) -> str:
    """The settings of a job in short form: those of `keys`, or else all."""
    return label({key: settings[key] for key in keys if key in settings} or settings)


def from_here(folder: Path) -> Path:
    """A folder below the current one, named from there; else as it is."""
    return folder.relative_to(here) if folder.is_relative_to(here := Path.cwd()) else folder


def quoted(folder: Path) -> str:
    """A folder, named from here, in a command."""
    return shlex.quote(str(from_here(folder)))


def board_lines(folder: Path, page: str) -> list[str]:
    """The command that starts TensorBoard, and the address of a page of it."""
    return [
        f"TensorBoard  tensorboard --logdir {quoted(folder)}",
        f"             then http://localhost:6006/{page}",
    ]


def program(name: str) -> str:
    """How another command is called, in the way in which this one was: `python evaluate.py` or `usvlearn evaluate`."""
    installed = sys.argv[0].startswith("usvlearn ") and not sys.argv[0].endswith(".py")
    return f"usvlearn {name}" if installed else f"python {name}.py"


def tuning_table(title: str, rows: Sequence[tuple[str, str, Mapping]]) -> Blocks:
    """One row per setting: rank or name, the setting, MAE in m/s, and the gain in percent."""
    table = Blocks(title, ["", "setting"], ["MAE, m/s", "gain, %"], folded=["setting"])
    for k, (rank, setting, row) in enumerate(rows):
        mae = "diverged" if row["mae"] is None else f"{row['mae']:.5f}"
        table.add(rank, setting, mae, number(row.get("gain"), 1), style="" if k else "bold")
    return table
