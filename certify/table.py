"""The table that `python -m certify` prints."""

from __future__ import annotations

import math
import os
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from certify.exact import CORNER

MARGINS = tuple(CORNER)
MARKS = {
    "certified": ("✓", "green"),
    "refuted": ("✗", "red"),
    "not certified": ("✗", "red"),
    "unknown": ("?", "yellow"),
}


def show(rows: Sequence[dict[str, Any]], condition: str, held: Sequence[bool], notes: Sequence[str], dt: float | None):
    """One row per parameter set, and a summary."""
    console = _console()
    console.print(_table(rows, dt))
    console.print(*summary(rows, condition, held), *notes, sep="\n", soft_wrap=True)


def _console() -> Console:
    """As wide as the terminal; wide where there is none, so that no line of a file is folded."""
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 200
    return Console(markup=False, highlight=False, width=width)


def _table(rows: Sequence[dict[str, Any]], dt: float | None) -> Table:
    marks = ", ".join(f"{mark} {word}" for word, (mark, _) in MARKS.items() if word != "not certified")
    table = Table(box=SIMPLE_HEAD, title="Margins, > 0 where a condition holds, and rates", padding=(0, 1, 0, 0))
    table.title_justify = table.caption_justify = "left"
    solved, boxed = (any(key in row for row in rows) for key in ("lmi", "box"))
    paths, shared = _short([row["path"] for row in rows])
    table.caption = f"below {shared}" + f"; {marks}" * (solved or boxed) if shared else marks * (solved or boxed)
    table.add_column("parameter set", overflow="fold", min_width=14)
    for name in ("n", *MARGINS, "rate K", "τ, steps" if dt is None else "τ, s"):
        table.add_column(name, justify="right", no_wrap=True)
    for heading in ["LMI lmi, tight"] * solved + ["on the box"] * boxed:
        table.add_column(heading, no_wrap=True)
    table.add_column("equilibria", overflow="fold", min_width=12)
    for row, path in zip(rows, paths, strict=True):
        margins = [
            Text(f"{row['margins'][name]:.3g}", "green" if row["certified"][name] else "red") for name in MARGINS
        ]
        cells = [_lmi(row["lmi"])] if solved else []
        cells += [_box(row["box"])] if boxed else []
        constant = time_constant(row["time_constant"], dt)
        table.add_row(path, str(row["n"]), *margins, f"{row['rate']:.6g}", constant, *cells, _places(row["equilibria"]))
    return table


def _short(paths: Sequence[str]) -> tuple[list[str], str]:
    """The paths without what all of them share, and the folder that they share."""
    if len(paths) == 1:
        return [paths[0]], ""
    paths = [os.path.abspath(path) for path in paths]
    shared = os.path.commonpath([os.path.dirname(path) for path in paths])
    ending = {os.path.splitext(path)[1] for path in paths}
    names = [os.path.relpath(path, shared) for path in paths]
    return [name.removesuffix(*ending) if len(ending) == 1 else name for name in names], os.path.relpath(shared)


def time_constant(steps: float | None, dt: float | None) -> str:
    """τ = −1/ln K in steps, or in s."""
    return "–" if steps is None else f"{steps * (dt or 1):.3g}"


def _places(equilibria: Sequence[dict[str, Any]]) -> str:
    kinds: dict[str, list[str]] = {}
    for each in equilibria:
        ends = each.get("interval")
        place = f"{each['x']:.3g}" if ends is None else f"{ends[0]:.3g}…{ends[1]:.3g}"
        kinds.setdefault(each["class"], []).append(place)
    return "; ".join(f"{kind} {', '.join(places)}" for kind, places in kinds.items()) or "none"


def _mark(verdict: str) -> Text:
    return Text(*MARKS[verdict])


def _lmi(found: dict[str, Any]) -> Text:
    told = Text()
    for condition in ("lmi", "tight"):
        rate = found[condition]["rate"]
        told.append(_mark(found[condition]["verdict"])).append(" –  " if rate is None else f" {rate:.4g}  ")
    return told


def _box(found: dict[str, Any]) -> Text:
    low, high = found["bracket"]
    rate = f"{high:.4g}" if found["closed"] else f"{low:.4g}…{high:.4g}"
    kept = {"yes": "kept", "no": "left", "unknown": "?"}[found["forward_invariant"]]
    return Text().append(_mark(found["verdict"])).append(f" {rate}, {kept}")


def summary(rows: Sequence[dict[str, Any]], condition: str, held: Sequence[bool]) -> list[str]:
    """What it came to, in a few lines."""
    n = len(rows)
    counts = Counter(name for row in rows for name in MARGINS if row["certified"][name])
    gauge = Counter(name for row in rows for name, held in row["best_gauge"].items() if held)
    told = [
        f"{sum(held)} of {n} certified contracting by {condition}, in rational arithmetic",
        ", ".join(f"{name} {counts[name]}" for name in MARGINS)
        + f"; after rescaling neurons: simple {gauge['simple']}, gershgorin {gauge['gershgorin']}",
    ]
    if rests := [row["at_rest"] for row in rows if "at_rest" in row]:
        numbers = sorted({k for rest in rests for k in rest["equilibria"]})
        places = sorted(x for rest in rests for x in rest["x"])
        kinds = sorted({kind for rest in rests for kind in rest["classes"]})
        told.append(
            f"at rest, over {rests[0]['headings']} headings: {'…'.join(map(str, numbers))} equilibria each"
            + (f", x in {places[0]:.3g}…{places[-1]:.3g}, {', '.join(kinds)}" if places else "")
        )
    if any("box" in row for row in rows):
        verdicts = Counter(row["box"]["verdict"] for row in rows)
        kept = Counter(row["box"]["forward_invariant"] for row in rows)
        told.append(
            f"on the box: {', '.join(f'{word} {count}' for word, count in verdicts.items())}; "
            + "f maps the box into itself: "
            + ", ".join(f"{word} {count}" for word, count in kept.items())
        )
        if refuted := next((row for row in rows if row["box"]["verdict"] == "refuted"), None):
            point = refuted["box"]["witness"]
            u = ", ".join(f"{x:.4g}" for x in point["u"])
            told.append(f"witness: {refuted['path']}: slope {point['slope']:.6g} at x = {point['x']:.4g}, u = ({u})")
    return told


def progress(items: Sequence, told: str):
    """The items, with a bar on the standard error stream that leaves no trace."""
    from rich.progress import track

    return track(items, told, console=Console(stderr=True), transient=True)


def show_comparison(result: dict[str, Any]) -> None:
    """The tables of `certify.compare`."""
    console = _console()
    for name, family in result["families"].items():
        table = Table(box=SIMPLE_HEAD, title_justify="left",
                      title=f"{name}: {len(family['networks'])} networks of {result['neurons']} neurons")  # fmt: skip
        headings = ("tier", "certified", "rate/exact", "largest K certified", "time constant", "solver disagrees")
        for k, heading in enumerate(headings):
            table.add_column(heading, justify="right" if k else "left")
        for tier, row in family["tiers"].items():
            K, ratio = row["largest_K"], row["conservatism"]
            slowest = "–" if K is None or not 0 < K < 1 else f"{-result['dt'] / math.log(K):.3g} s"
            table.add_row(
                tier,
                f"{100 * row['share']:.0f} %",
                "–" if ratio is None else f"{ratio:.3g}",
                "–" if K is None else f"{K:.4g}",
                slowest,
                "" if row["disagreements"] is None else str(row["disagreements"]),
            )
        console.print(table)
    console.print(_timing_table(result["timings"]))
    if result["paper"]:
        console.print(_paper_table(result["paper"]))


def _timing_table(rows: Sequence[dict[str, Any]]) -> Table:
    table = Table(box=SIMPLE_HEAD, title="Time of one network; ratio: LMI solved again / closed form",
                  title_justify="left")  # fmt: skip
    keys = {"closed_tight": "closed form", "exact_rate": "exact rate", "proof": "p, Λ, LDLᵀ", "box": "box",
            "lmi_first": "LMI first", "lmi_again": "LMI again"}  # fmt: skip
    for heading in ("n", *keys.values(), "ratio"):
        table.add_column(heading, justify="right")
    for row in rows:
        ratio = "–" if row["lmi_again"] is None else f"{row['lmi_again'] / row['closed_tight']:.2g}"
        table.add_row(str(row["n"]), *(_seconds(row[key]) for key in keys), ratio)
    return table


def _seconds(x: float | None) -> str:
    if x is None:
        return "–"
    return next(f"{x * scale:.3g} {unit}" for scale, unit in ((1, "s"), (1e3, "ms"), (1e6, "µs")) if x * scale >= 1)


def _paper_table(rows: Sequence[dict[str, Any]]) -> Table:
    table = Table(box=SIMPLE_HEAD, title="The paper's tests, literally and mended", title_justify="left")
    for heading in ("test", "accepted at 0.999 of its edge", "accepted just beyond", "identity", "wrong"):
        table.add_column(heading, justify="right" if heading != "test" else "left")
    for row in rows:
        if "wrong" in row:
            table.add_row(row["test"], "", "", "", "{} of {}".format(*row["wrong"]))
        else:
            wrong = row["identity"] + max(0, row["beyond"][0] - row["contracting"])
            identity = "accepted" if row["identity"] else "refused"
            table.add_row(row["test"], "{} of {}".format(*row["inside"]), "{} of {}".format(*row["beyond"]), identity,
                          f"{wrong} not contracting")  # fmt: skip
    return table
