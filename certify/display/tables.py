"""The tables that `python -m certify` prints."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from certify.analysis.assess import MOST_FULL
from certify.errors import folded
from certify.proofs import vector_certificate
from certify.proofs.exact import CORNER
from certify.proofs.rounding import above, below

MARGINS = tuple(CORNER)
UNLIMITED = 100_000  # columns of a file or a pipe
FOLDED = 24  # least width, in columns, of a text that may be folded
GAP = 2
MARKS = {
    "certified": ("✓", "green"),
    "refuted": ("✗", "red"),
    "not certified": ("✗", "red"),
    "unknown": ("?", "yellow"),
}
NORMS = {"inf": "∞", "one": "1"}


def show(rows: Sequence[dict[str, Any]], condition: str | None, notes: Sequence[str], dt: float | None) -> None:
    """One row per checkpoint, and a summary; networks with a vector state have a table of their own.

    Rows are of `certify.analysis.assess.assess`, with the condition that certifies each: `judged`. `dt`, s, is a step.
    """
    console, lines = _console(), []
    if one := [row for row in rows if "states" not in row]:
        _print(console, *_table(one, dt))
        lines += _summary(one, "exact" if condition in (None, "quadratic") else condition)
    if vectors := [row for row in rows if "states" in row]:
        _print(console, *_vector_table(vectors, dt))
        lines += _vector_summary(vectors)
    _say(console, *lines, *notes)


def _console() -> Console:
    """A console as wide as the terminal; without a limit for a file or a pipe, unless COLUMNS sets one."""
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else UNLIMITED
    return Console(markup=False, highlight=False, width=width)


def _say(console: Console, *lines: str, style: str | None = None) -> None:
    """Print lines, broken between words."""
    for line in lines:
        console.print(folded(line, console.width), style=style, soft_wrap=True)


def _print(
    console: Console,
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str | Text]],
    texts: Sequence[str] = (),
) -> None:
    """Print a table. If it is too wide, its columns continue in further tables below, each with the first column.

    The first heading is that of the names; like these, columns headed by `texts` may be folded between words.
    """
    cells = list(zip(headings, *([str(cell) for cell in row] for row in rows), strict=True))
    widths = [max(map(cell_len, column)) for column in cells]
    widths = [min(width, FOLDED) if name in texts else width for name, width in zip(headings, widths, strict=True)]
    room = min(console.width // 2, console.width - GAP - max(widths[1:]))
    widths[0] = min(widths[0], max(room, FOLDED // 2))
    blocks: list[list[int]] = [[]]
    for k in range(1, len(headings)):
        if blocks[-1] and sum(widths[j] + GAP for j in (0, *blocks[-1], k)) > console.width:
            blocks.append([])
        blocks[-1].append(k)
    _say(console, title, style="italic")
    for block in blocks:
        table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
        for k in (0, *block):
            text = k == 0 or headings[k] in texts
            style: dict[str, Any] = {"overflow": "fold", "min_width": widths[k]} if text else {"no_wrap": True}
            table.add_column(headings[k], justify="left" if text else "right", **style)
        for row in rows:
            table.add_row(*(row[k] for k in (0, *block)))
        console.print()
        console.print(table)
    console.print()


def _table(
    rows: Sequence[dict[str, Any]], dt: float | None
) -> tuple[str, list[str], list[list[str | Text]], Sequence[str]]:
    """The title, headings, rows and texts of `_print`."""
    solved, boxed = (any(key in row for row in rows) for key in ("lmi", "box"))
    paths, shared = _short([row["path"] for row in rows])
    marks = ", ".join(f"{mark} {word}" for word, (mark, _) in MARKS.items() if word != "not certified")
    title = f"Margins, > 0 where a condition holds, and rates of what is in {shared}" + f"; {marks}" * (solved or boxed)
    headings = ["checkpoint", "n", *MARGINS, "rate K", "τ, steps" if dt is None else "τ, s"]
    headings += ["LMI lmi, exact"] * solved + ["on the box"] * boxed + ["equilibria"]
    lines: list[list[str | Text]] = []
    for row, path in zip(rows, paths, strict=True):
        margins = [
            Text(below(row["margins"][name], 3), "green" if row["certified"][name] else "red") for name in MARGINS
        ]
        cells = [_lmi(row["lmi"])] if solved else []
        cells += [_box(row["box"])] if boxed else []
        constant = _time_constant(row["time_constant"], dt)
        lines.append([path, str(row["n"]), *margins, above(row["rate"]), constant, *cells, _every_place(row)])
    return title, headings, lines, ["equilibria"]


def _time_constant(steps: float | None, dt: float | None) -> str:
    """τ = −1/ln K in steps, or in s, rounded up."""
    return "–" if steps is None else above(steps * (dt or 1), 3)


def _mark(verdict: str) -> Text:
    """The mark of a verdict, in its colour."""
    return Text(*MARKS[verdict])


def _short(paths: Sequence[str]) -> tuple[list[str], str]:
    """The paths without their common folder, and that folder."""
    paths = [os.path.abspath(path) for path in paths]
    shared = os.path.commonpath([os.path.dirname(path) for path in paths])
    ending = {os.path.splitext(path)[1] for path in paths} if len(paths) > 1 else {""}
    names = [os.path.relpath(path, shared) for path in paths]
    names = [name.removesuffix(*ending) if len(ending) == 1 else name for name in names]
    return names, min(os.path.relpath(shared), shared, key=len)


def _every_place(row: dict[str, Any]) -> str:
    """The equilibria in [0, 1]; where there are none, those outside."""
    if row["equilibria"]:
        return _places(row["equilibria"])
    outside = _places(row.get("equilibria_outside", []))
    return f"none in 0…1; {outside}" if outside else "none in 0…1"


def _places(equilibria: Sequence[dict[str, Any]]) -> str:
    kinds: dict[str, list[str]] = {}
    for each in equilibria:
        ends = each.get("interval")
        place = f"{each['x']:.3g}" if ends is None else f"{ends[0]:.3g}…{ends[1]:.3g}"
        kinds.setdefault(each["class"], []).append(place)
    return "; ".join(f"{kind} {', '.join(places)}" for kind, places in kinds.items())


def _lmi(solved: dict[str, Any]) -> Text:
    marks = Text()
    for condition in ("lmi", "exact"):
        rate = solved[condition]["rate"]
        marks.append(_mark(solved[condition]["verdict"])).append(" –  " if rate is None else f" {rate:.4g}  ")
    return marks


def _box(search: dict[str, Any]) -> Text:
    low, high = search["bracket"]
    rate = above(high, 4) if search["closed"] else f"{below(low, 4)}…{above(high, 4)}"
    stays = {"yes": "kept", "no": "left", "unknown": "?"}[search["forward_invariant"]]
    return Text().append(_mark(search["verdict"])).append(f" {rate}, {stays}")


def _summary(rows: Sequence[dict[str, Any]], condition: str | None) -> list[str]:
    """The result in a few lines."""
    n, held = len(rows), sum(bool(row["judged"]) for row in rows)
    counts = Counter(name for row in rows for name in MARGINS if row["certified"][name])
    gauge = Counter(name for row in rows for name, holds in row["best_gauge"].items() if holds)
    lines = [
        f"{held} of {n} certified contracting by {condition}, in rational arithmetic",
        ", ".join(f"{name} {counts[name]}" for name in MARGINS)
        + f"; after rescaling neurons: simple {gauge['simple']}, gershgorin {gauge['gershgorin']}",
    ]
    if rests := [row["at_rest"] for row in rows if "at_rest" in row]:
        numbers = sorted({k for rest in rests for k in rest["equilibria"]})
        places = sorted(x for rest in rests for x in rest["x"])
        kinds = sorted({kind for rest in rests for kind in rest["classes"]})
        lines.append(
            f"at rest, over {rests[0]['headings']} headings: {'…'.join(map(str, numbers))} equilibria each"
            + (f", x in {places[0]:.3g}…{places[-1]:.3g}, {', '.join(kinds)}" if places else "")
        )
    if any("box" in row for row in rows):
        verdicts = Counter(row["box"]["verdict"] for row in rows)
        invariance = Counter(row["box"]["forward_invariant"] for row in rows)
        lines.append(
            f"on the box: {', '.join(f'{word} {count}' for word, count in verdicts.items())}; "
            + "f maps the box into itself: "
            + ", ".join(f"{word} {count}" for word, count in invariance.items())
        )
        if refuted := next((row for row in rows if row["box"]["verdict"] == "refuted"), None):
            point = refuted["box"]["witness"]
            u = ", ".join(f"{x:.4g}" for x in point["u"])
            slope = ("−" if point["slope"] < 0 else "") + below(abs(point["slope"]))
            lines.append(f"witness: {refuted['path']}: slope {slope} at x = {point['x']:.4g}, u = ({u})")
    return lines


def _vector_table(
    rows: Sequence[dict[str, Any]], dt: float | None
) -> tuple[str, list[str], list[list[str | Text]], Sequence[str]]:
    """The title, headings, rows and texts of `_print`."""
    paths, shared = _short([row["path"] for row in rows])
    shown = [name for name in vector_certificate.CONDITIONS if any(name in row["rates"] for row in rows)]
    stepped = any("steps" in row for row in rows)
    unit = "steps" if dt is None else "s"
    headings = ["checkpoint", "q", "n", "φ", *(f"rate {name}" for name in shown), "norm", f"τ, {unit}"]
    headings += [f"all steps to, {unit}"] * stepped
    lines = []
    for row, path in zip(rows, paths, strict=True):
        line: list[str | Text] = [path, str(row["states"]), str(row["n"]), row["activation"]]
        line += [_proved_rate(row, name) for name in shown]
        line += [_norm(row), _time_constant(row["time_constant"], dt)]
        if stepped:
            steps = row.get("steps")
            line.append("–" if steps is None else below(Fraction(steps["proved"]) * Fraction(dt or 1), 4))
        lines.append(line)
    return f"Proved rates of what is in {shared}; below 1 it contracts", headings, lines, ()


def _proved_rate(row: dict[str, Any], name: str) -> Text:
    rate = row["rates"].get(name)
    if rate is None:
        return Text("–", "red")
    return Text(above(rate, 4), "green" if row["certified"].get(name) else "red")


def _norm(row: dict[str, Any]) -> str:
    """The norm of the exact rate: ∞ or 1, and whether the states are scaled one by one or mixed."""
    scaling = row["scaling"]
    mixed = any(x != "0" for i, line in enumerate(scaling) for j, x in enumerate(line) if i != j)
    plain = not mixed and all(scaling[i][i] == scaling[0][0] for i in range(len(scaling)))
    return NORMS[row["norm"]] + ("" if plain else ", mixed" if mixed else ", scaled")


def _vector_summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The result in a few lines."""
    held = [row["judged"] for row in rows]
    counts = {name: held.count(name) for name in vector_certificate.CONDITIONS if name in held}
    by = ", ".join(f"{name} {count}" for name, count in counts.items())
    lines = [
        f"{len(rows) - held.count(None)} of {len(rows)} with a vector state certified contracting"
        + (f" (by {by})" if by else "") + ", in rational arithmetic"
    ]  # fmt: skip
    open_rows = [row for row in rows if row["judged"] is None and "solver" not in row]
    if any("recurrent" in row and row["states"] > MOST_FULL for row in open_rows):
        lines.append(f"above {MOST_FULL} states diagonal metrics alone are tried: a full one may prove more")
    if any("recurrent" not in row and not row["certified"]["exact"] for row in open_rows):
        lines.append("a full metric P may prove more: --lmi searches for it (extra lmi)")
    return lines


def progress(items: Sequence, lines: str):
    """The items, with a temporary progress bar on the standard error stream."""
    from rich.progress import track

    return track(items, lines, console=Console(stderr=True), transient=True)


def show_comparison(rows: Sequence[dict[str, Any]]) -> None:
    """The table of `certify.command.compare`."""
    console, solved = _console(), any(row["disagreements"] is not None for row in rows)
    several = len({row["networks"] for row in rows}) > 1
    headings = ["condition", *["networks"] * several, "certified", "95 %", "rate/K", "largest rate"]
    headings += ["solver differs"] * solved
    lines: list[list[str | Text]] = []
    for row in rows:
        ends = "–" if row["interval"] is None else "{:.0%}…{:.0%}".format(*row["interval"])
        cells = ["–" if row[key] is None else above(row[key], 4) for key in ("over_K", "largest")]
        line: list[str | Text] = [row["condition"], *[row["networks"]] * several, f"{row['certified']} of {row['of']}"]
        differs = "–" if row["disagreements"] is None else str(row["disagreements"])
        lines.append([*line, ends, *cells, *[differs] * solved])
    title = f"{rows[0]['networks']}: networks that each condition certifies" if not several else "certified networks"
    _print(console, title, headings, lines, ["networks"])
    _say(
        console,
        "rate/K: the median of the smallest rate at which a condition holds, over the exact rate K of all activation "
        "patterns. largest rate: of the networks that it certifies; box: on the operating box.",
    )
