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

MARGINS = ("simple", "gershgorin", "lmi", "tight")
WORDS = {"certified": "green", "refuted": "red", "not certified": "red", "unknown": "yellow"}


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
    table = Table(box=SIMPLE_HEAD, title="Contraction: margin > 0 where a condition holds", title_justify="left")
    table.add_column("parameter set", overflow="fold")
    table.add_column("n", justify="right")
    for name in MARGINS:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("rate K", justify="right", no_wrap=True)
    table.add_column("time constant", justify="right", no_wrap=True)
    more = [key for key in ("lmi", "box") if any(key in row for row in rows)]
    for key in more:
        table.add_column({"lmi": "LMI solved", "box": "on the box"}[key])
    table.add_column("equilibria", overflow="fold")
    paths = [os.path.abspath(row["path"]) for row in rows]
    shared = os.path.commonpath([os.path.dirname(path) for path in paths]) if len(paths) > 1 else ""
    if shared:
        table.caption, table.caption_justify = f"below {os.path.relpath(shared)}", "left"
    for row in rows:
        cells: list[str | Text] = [
            os.path.relpath(os.path.abspath(row["path"]), shared) if shared else row["path"],
            str(row["n"]),
        ]
        for name in MARGINS:
            cells.append(Text(f"{row['margins'][name]:.4g}", "green" if row["certified"][name] else "red"))
        cells += [f"{row['rate']:.6g}", time_constant(row["time_constant"], dt)]
        cells += [{"lmi": _lmi, "box": _box}[key](row[key]) for key in more]
        table.add_row(*cells, equilibria(row))
    return table


def time_constant(steps: float | None, dt: float | None) -> str:
    """−1/ln K in steps, or in s."""
    if steps is None:
        return "–"
    return f"{steps:.3g} steps" if dt is None else f"{steps * dt:.3g} s"


def equilibria(row: dict[str, Any]) -> Text:
    """Places by class, at the input asked for, and over headings at rest."""
    kinds: dict[str, list[str]] = {}
    for each in row["equilibria"]:
        ends = each.get("interval")
        kinds.setdefault(each["class"], []).append(
            f"{each['x']:.4g}" if ends is None else f"{ends[0]:.4g}…{ends[1]:.4g}"
        )
    told = "; ".join(f"{kind} {', '.join(places)}" for kind, places in kinds.items()) or "none"
    if rest := row.get("at_rest"):
        least, most = rest["equilibria"]
        count = f"{least}" if least == most else f"{least}…{most}"
        where = f" in {rest['x'][0]:.3g}…{rest['x'][1]:.3g}, {', '.join(rest['classes'])}" if rest["x"] else ""
        told += f" | at rest, all headings: {count}{where}"
    return Text(told)


def _lmi(found: dict[str, Any]) -> Text:
    told = Text()
    for condition in ("lmi", "tight"):
        solution = found[condition]
        told.append(f"{condition} ").append(solution["verdict"], WORDS.get(solution["verdict"], ""))
        rate = "" if solution["rate"] is None else f", rate {solution['rate']:.6g}"
        told.append(f"{rate}, {1e3 * solution['seconds']:.3g} ms" + ("; " if condition == "lmi" else ""))
    return told


def _box(found: dict[str, Any]) -> Text:
    low, high = found["bracket"]
    rate = f"{high:.6g}" if found["closed"] else f"{low:.6g}…{high:.6g}"
    told = Text(found["verdict"], WORDS.get(found["verdict"], ""))
    invariant = {"yes": "forward invariant", "no": "x can leave it", "unknown": "invariance unknown"}
    return told.append(f", rate {rate}, {invariant[found['forward_invariant']]}")


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
    if any("box" in row for row in rows):
        verdicts = Counter(row["box"]["verdict"] for row in rows)
        told.append("on the box: " + ", ".join(f"{word} {count}" for word, count in verdicts.items()))
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
