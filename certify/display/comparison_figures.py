"""The pictures of a comparison, one question each. Lines are named at their right ends, beside the axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.analysis.comparison_counts import GAUGED, SEEN, TIERS, steps_of
from certify.display.comparison_tables import TIMES, limit
from certify.display.figures import INK, PALE, TIER_COLOURS, blank, save
from certify.errors import CertifyError

COLOURS = {**TIER_COLOURS, **{GAUGED[name]: TIER_COLOURS[name] for name in GAUGED}}
FAMILIES = (("#009E73", "o"), ("#E69F00", "^"), ("#CC79A7", "s"), ("#D55E00", "D"), ("#56B4E9", "v"), (INK, "P"))
TIME_COLOURS = {"closed_tight": TIER_COLOURS["tight"], "exact_rate": PALE, "proof": INK, "box": TIER_COLOURS["box"],
                "lmi_again": TIER_COLOURS["lmi"], "lmi_first": "#882255", "solver": "#E69F00"}  # fmt: skip
SMALL = 8.5  # size of text
APART = 0.052  # least distance of two names beside the axes, in heights of the axes
WIDTH, HEIGHT = 7.6, 4.2  # inches


class Picture(NamedTuple):
    """A figure, and what it shows in a sentence or two."""

    figure: Any  # of matplotlib
    caption: str


def pictures(result: Mapping[str, Any]) -> dict[str, Picture]:
    """The pictures by name, those that have something to show.

    Args:
        result: see `certify.command.compare.study`.

    Raises:
        CertifyError: matplotlib is not installed.
    """
    drawings: dict[str, Callable[[Mapping[str, Any]], Picture | None]] = {
        "signs": _signs, "neurons": _neurons, "shares": _shares, "constants": _constants, "times": _times,
        "box_times": _box_times,
    }  # fmt: skip
    drawn = {name: draw(result) for name, draw in drawings.items()}
    return {name: picture for name, picture in drawn.items() if picture is not None}


def check_drawing(path: str | None) -> None:
    """Check before the work that pictures can be drawn, and written to files such as `path`.

    Raises:
        CertifyError: matplotlib is not installed, or the path's ending is no format of it.
    """
    known = blank("a picture of the comparison").canvas.get_supported_filetypes()
    if path is not None and Path(path).suffix.lstrip(".").lower() not in known:
        raise CertifyError(f"--plot: found {path!r}, expected a file such as compare.png or compare.pdf")


def save_all(drawn: Mapping[str, Picture], path: Path) -> None:
    """Write each picture beside `path`, with its name in the file's: compare.png becomes compare-signs.png."""
    for name, picture in drawn.items():
        save(picture.figure, path.with_name(f"{path.stem}-{name}{path.suffix}"))


def _signs(result: Mapping[str, Any]) -> Picture | None:
    figure, axes = _axes("the share of neurons whose sᵢ has the rarer sign", "σ/K, best-gauge Gershgorin over LMI")
    share = np.linspace(0, 0.5, 101)
    names = [(2.0, "bound 2", PALE)]
    axes.axhline(2, color=PALE, linewidth=1)
    axes.axhline(1, color=PALE, linewidth=1)
    axes.plot(100 * share, 1 / (1 - share), color=INK, linewidth=1, dashes=(4, 3), zorder=3)
    sizes = list(dict.fromkeys(row["n"] for row in result["by_signs"]))
    for n, colour in zip(sizes, ("#C44D80", "#0072B2"), strict=False):
        rows = [row for row in result["by_signs"] if row["n"] == n and row["ratio"]]
        x, middle = [100 * row["rarer"] for row in rows], [row["ratio"]["median"] for row in rows]
        low, high = ([row["ratio"]["spread"][k] for row in rows] for k in (0, 1))
        axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(x, middle, color=colour, marker="o", markersize=4.5, linewidth=1.8, zorder=4)
        names.append((middle[-1], f"n = {n}", colour))
    spread = np.random.default_rng(0)  # dots of one share are drawn beside each other
    for (name, family), (colour, marker) in zip(result["families"].items(), cycle(FAMILIES), strict=False):
        known = [row["loss"] for row in family["networks"] if row["loss"] is not None]
        axes.plot(
            [100 * each["rarer"] + spread.uniform(-0.7, 0.7) for each in known], [each["ratio"] for each in known],
            marker, markersize=3.6, markeredgewidth=0, alpha=0.8, color=colour, label=f"{_short(name)}: {len(known)}",
            zorder=2,
        )  # fmt: skip
    axes.set(xlim=(-1.5, 51.5), ylim=(0.95, 2.05))
    axes.set_xticks(range(0, 51, 10), [f"{x} %" for x in range(0, 51, 10)])
    axes.set_yticks([1, 1.25, 1.5, 1.75, 2])
    _name_ends(axes, names)
    _legend(axes, "dots: networks")
    counts = {row["networks"] for row in result["by_signs"]}
    return Picture(
        figure,
        f"What Gershgorin loses by itself. Lines: medians of {_range(counts)} networks for each share and n; bands: 5 "
        "to 95 % of them; dots: the networks of the families; dashed: 1/(1 − share), where all |sᵢ| are equal.",
    )


def _neurons(result: Mapping[str, Any]) -> Picture | None:
    family = result["by_neurons"][0]["family"]
    rows = [row for row in result["by_neurons"] if row["family"] == family]
    figure, axes = _axes("neurons n", "smallest rate that is proved / K")
    names, heights = [], [1.0]
    for tier in SEEN:
        known = [(row["n"], row["tiers"][tier]) for row in rows if row["tiers"][tier]["median"] is not None]
        if not known:
            continue
        style = "--" if tier in GAUGED.values() else "-"
        x, middle = [n for n, _ in known], [found["median"] for _, found in known]
        both = [(n, *found["spread"]) for n, found in known if None not in found["spread"]]
        if both and tier not in ("lmi", "tight"):
            sizes, low, high = map(list, zip(*both, strict=True))
            axes.fill_between(sizes, low, high, color=COLOURS[tier], alpha=0.12, linewidth=0)
            heights += high
        axes.plot(x, middle, color=COLOURS[tier], marker="o", markersize=4, linewidth=1.8, linestyle=style)
        names.append((middle[-1], tier, COLOURS[tier]))
        heights += middle
    axes.set(xscale="log", yscale="log", ylim=(0.85, 1.25 * max(heights)))
    _ticks(axes.set_xticks, apart([row["n"] for row in rows]))
    _ticks(axes.set_yticks, [y for y in (1, 2, 4, 8, 16, 32, 64, 128, 256) if y < 1.25 * max(heights)])
    axes.minorticks_off()
    _name_ends(axes, names)
    return Picture(
        figure,
        f"How the loss grows with n, on {family} networks, {rows[0]['networks']} of each n. Lines: medians; bands: 5 "
        "to 95 % of the networks; dashed: in the best gauge. 1 is the exact rate over all activation patterns.",
    )


def _shares(result: Mapping[str, Any]) -> Picture | None:
    families = result["families"]
    width = WIDTH * max(1.0, (1 + len(families)) / 6)
    figure = blank("the pictures of the comparison", figsize=(width, 3.7), dpi=110, layout="constrained")
    figure.supxlabel("share of the networks that are certified, %", fontsize=SMALL + 1, color=INK)
    panels = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
    for axes, (name, family) in zip(panels, families.items(), strict=True):
        for k, tier in enumerate(TIERS):
            found = family["tiers"][tier]
            share, interval = 100 * found["share"], found["share_interval"]
            if interval is not None:
                axes.plot([100 * x for x in interval], [k, k], color=COLOURS[tier], linewidth=2.4, alpha=0.45,
                          solid_capstyle="butt")  # fmt: skip
            hollow = {"markerfacecolor": "white"} if tier in GAUGED.values() else {}
            axes.plot([share], [k], "o", color=COLOURS[tier], markersize=6.5, clip_on=False, zorder=4, **hollow)
        axes.set(xlim=(-4, 104), ylim=(len(TIERS) - 0.5, -0.5))
        axes.set_xticks([0, 50, 100])
        axes.set_yticks(range(len(TIERS)), TIERS)
        _plain(axes)
        axes.tick_params(axis="y", length=0)
        axes.set_title(f"{_short(name)}\n{len(family['networks'])} networks", fontsize=SMALL + 0.5, color=INK)
    return Picture(
        figure,
        "The share of networks that each condition certifies. Bars: Wilson's 95 % intervals, of drawn families alone. "
        "Hollow: in the best gauge.",
    )


def _constants(result: Mapping[str, Any]) -> Picture | None:
    rows = {}
    for name, family in result["families"].items():
        known = [(row["dt"] * steps, row) for row in family["networks"]
                 if row["dt"] and (steps := steps_of(row["K_box"][1]))]  # fmt: skip
        if known:
            rows[name] = (known, max(row["dt"] for _, row in known), max(row["n"] for _, row in known))
    if not rows:
        return None
    figure = blank("the pictures of the comparison", figsize=(WIDTH, 1.5 + 0.95 * len(rows)), dpi=110)
    axes = figure.add_axes((0.16, 0.52 / (1.5 + 0.95 * len(rows)), 0.62, 1 - 0.85 / (1.5 + 0.95 * len(rows))))
    _plain(axes)
    order = [tier for tier in TIERS if tier not in GAUGED.values()]
    seen: dict[str | None, int] = {}
    spread = np.random.default_rng(0)  # heights of dots within a row mean nothing
    values = []
    for k, (known, dt, n) in enumerate(rows.values()):
        for constant, row in known:
            tier = next((tier for tier in order if row["certified"][tier]), None)
            seen[tier] = seen.get(tier, 0) + 1
            colour = PALE if tier is None else COLOURS[tier]
            axes.plot([constant], [k + spread.uniform(-0.2, 0.2)], ".", color=colour, markersize=8, alpha=0.75)
            values.append(constant)
        for tier, text in (("simple", "simple"), ("lmi", "gershgorin, lmi")):
            most = dt * (steps_of(limit(tier, n) or 0.5) or 0.0)
            values.append(most)
            axes.plot([most, most], [k - 0.36, k + 0.3], color=COLOURS[tier], linewidth=2)
            side = "right" if tier == "simple" else "left"
            axes.annotate(f"{text} < {most:.2g} s", (most, k - 0.36), (2 if side == "left" else -2, 2),
                          textcoords="offset points", ha=side, va="bottom", fontsize=SMALL - 1, color=INK)  # fmt: skip
    low, high = 0.2 * min(values), 1.3 * max(values)
    axes.set(xscale="log", xlim=(low, high), ylim=(len(rows) - 0.5, -0.65),
             xlabel="time constant −dt/ln K on the box, s")  # fmt: skip
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**k for k in decades for m in (1, 3) if low <= m * 10.0**k <= high]
    _ticks(axes.set_xticks, ticks)
    axes.minorticks_off()
    axes.set_yticks(range(len(rows)), [f"{_short(name)}\n{len(rows[name][0])} networks" for name in rows])
    axes.tick_params(axis="y", length=0)
    for tier, count in sorted(seen.items(), key=lambda each: TIERS.index(each[0]) if each[0] else len(TIERS)):
        colour = PALE if tier is None else COLOURS[tier]
        axes.plot([], [], ".", color=colour, markersize=9, label=f"{tier or 'no condition'}: {count}")
    _legend(axes, "narrowest condition", at=1.0)
    beyond = sum(row["K_box"][1] >= 1 for each in result["families"].values() for row in each["networks"] if row["dt"])
    return Picture(
        figure,
        "Which time constants can be certified: each dot is a network, coloured by the narrowest condition that "
        "certifies it; lines: the time constants that a condition cannot reach."
        + (f" Not drawn, since K ≥ 1 on the box: {beyond}." if beyond else ""),
    )


def _times(result: Mapping[str, Any]) -> Picture | None:
    figure, axes = _axes("neurons n", "time of one network")
    names, heights = [], []
    for key, label in TIMES.items():
        known = [(row["n"], row[key]) for row in result["timings"] if row[key] is not None]
        if known:
            axes.plot(*zip(*known, strict=True), marker="o", markersize=4, linewidth=1.6, color=TIME_COLOURS[key])
            names.append((known[-1][1], label, TIME_COLOURS[key]))
            heights += [y for _, y in known]
    for row in result["timings"]:
        if not row["box_closed"]:
            axes.plot(
                [row["n"]], [row["box"]], "o", color=COLOURS["box"], markerfacecolor="white", markersize=6, zorder=5
            )
    axes.set(xscale="log", yscale="log", ylim=(0.6 * min(heights), 1.8 * max(heights)))
    _ticks(axes.set_xticks, apart([row["n"] for row in result["timings"]]))
    _time_ticks(axes, heights)
    axes.minorticks_off()
    _name_ends(axes, names)
    solved = [row["n"] for row in result["timings"] if row["lmi_again"] is not None]
    unfinished = not all(row["box_closed"] for row in result["timings"])
    return Picture(
        figure,
        "How long the verdict on one network takes, the least of several calls, one thread, m = 4 inputs."
        + (f" The LMI is solved for n up to {max(solved)}." if solved else "")
        + (" Hollow: the search on the box ended at its time limit, with a bracket of the rate." if unfinished else ""),
    )


def _box_times(result: Mapping[str, Any]) -> Picture | None:
    rows = result["box_times"]
    figure, axes = _axes("inputs m", f"time of the exact rate on a box, n = {rows[0]['n']}")
    colour, heights = TIER_COLOURS["box"], [x for row in rows for x in row["seconds"]]
    axes.plot([row["m"] for row in rows], [float(np.median(row["seconds"])) for row in rows], color=colour,
              linewidth=1.6, label="median")  # fmt: skip
    for row in rows:
        axes.plot([row["m"]] * len(row["seconds"]), row["seconds"], ".", color=colour, markersize=7, alpha=0.7)
    axes.axhline(result["seconds"], color=PALE, linewidth=1, dashes=(4, 3))
    top = max(*heights, 2 * result["seconds"])
    axes.set(yscale="log", ylim=(0.6 * min(heights), 1.8 * top))
    axes.set_xticks([row["m"] for row in rows])
    _time_ticks(axes, [*heights, top])
    axes.minorticks_off()
    _name_ends(axes, [(float(np.median(rows[-1]["seconds"])), "median", colour),
                      (result["seconds"], f"limit {result['seconds']:g} s", PALE)])  # fmt: skip
    return Picture(
        figure,
        f"How the search on a box grows with the inputs: {len(rows[0]['seconds'])} initialised networks of each m. At "
        "the limit a search ends with a bracket of the rate instead of the rate.",
    )


def _axes(across: str, up: str):
    figure = blank("the pictures of the comparison", figsize=(WIDTH, HEIGHT), dpi=110)
    axes = figure.add_axes((0.1, 0.12, 0.66, 0.84))
    axes.set_xlabel(across, color=INK)
    axes.set_ylabel(up, color=INK)
    _plain(axes)
    return figure, axes


def _plain(axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#EEEEEE", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL)
    axes.set_facecolor("none")


def _ticks(put: Callable, places: Sequence[float]) -> None:
    put(places, [f"{x:g}" for x in places])


def apart(sizes: Sequence[int]) -> list[int]:
    """Those of the sizes whose labels do not touch on a logarithmic axis; the greatest is one of them.

    >>> apart([5, 10, 20, 50, 95, 100, 105])
    [5, 10, 20, 50, 105]
    """
    ordered = sorted(set(sizes), reverse=True)
    least = 0.07 * math.log(ordered[0] / ordered[-1])
    kept = ordered[:1]
    for n in ordered[1:]:
        if math.log(kept[-1] / n) >= least:
            kept.append(n)
    return kept[::-1]


def _time_ticks(axes, heights: Sequence[float]) -> None:
    units = {
        -6: "1 µs",
        -5: "10 µs",
        -4: "0.1 ms",
        -3: "1 ms",
        -2: "10 ms",
        -1: "0.1 s",
        0: "1 s",
        1: "10 s",
        2: "100 s",
    }
    inside = [k for k in units if 0.6 * min(heights) <= 10.0**k <= 1.8 * max(heights)]
    axes.set_yticks([10.0**k for k in inside], [units[k] for k in inside])


def _name_ends(axes, names: Sequence[tuple[float, str, str]]) -> None:
    """Names beside the right ends of lines, (height, text, colour), moved apart where they would overlap."""
    at = axes.transData.transform([(1.0, y) for y, _, _ in names])[:, 1]
    heights = axes.transAxes.inverted().transform(np.stack([np.zeros(len(at)), at], -1))[:, 1]
    order = np.argsort(heights)
    places = heights[order]
    for _ in range(200):
        gaps = APART - np.diff(places)
        if not (gaps > 1e-9).any():
            break
        for k in np.flatnonzero(gaps > 1e-9):
            places[k] -= gaps[k] / 2
            places[k + 1] += gaps[k] / 2
    for k, y in zip(order, places, strict=True):
        _, text, colour = names[k]
        axes.plot([1.005, 1.03], [heights[k], y], color=colour, linewidth=0.9, transform=axes.transAxes, clip_on=False)
        axes.text(1.04, y, text, transform=axes.transAxes, va="center", fontsize=SMALL, color=INK)


def _legend(axes, title: str, at: float = 0.55) -> None:
    axes.legend(loc="upper left", bbox_to_anchor=(1.02, at), frameon=False, fontsize=SMALL, title=title,
                title_fontsize=SMALL, alignment="left", borderaxespad=0, handletextpad=0.3)  # fmt: skip


def _short(name: str) -> str:
    return (name if len(name) <= 20 else f"{name[:19]}…").replace("$", r"\$")


def _range(counts: set[int]) -> str:
    return str(min(counts)) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
