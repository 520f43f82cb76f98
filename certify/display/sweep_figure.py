"""The figure of a sweep: stability against accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from certify.analysis.sweep_rows import narrowest, ranges, short_keys, short_values
from certify.display.figures import INK, TIER_COLOURS, blank
from certify.errors import CertifyError
from certify.proofs.rounding import above

MARKERS = {"simple": "o", "gershgorin": "s", "lmi": "D", "tight": "^", "interval": "v", "box": "P", None: "X"}
LIMITS = {"simple": 0.25, "lmi": 0.5, "tight": 1.0}  # the rates that a condition cannot reach
GREATEST = 1.3  # rate that is drawn to scale; greater ones lie at the right edge
LABELLED, LISTED = 12, 6  # most places with a label, if all have one; most that are listed beside the axes
BAR = "#C4C4C4"
LEAST = 1e-6  # m/s; less is not shown on a logarithmic axis
NEAR = 9.0  # pixels within which marks are one place
DPI = 110
POINT = 8  # size of text
WIDTH = 44  # characters of a row's name beside the axes


class Place(NamedTuple):
    """Rows that lie in one place of the figure, the best first."""

    x: float  # rate K, at most the right edge
    y: float  # error, m/s
    rows: list[Mapping[str, Any]]


def sweep_figure(rows: Sequence[Mapping[str, Any]]):
    """The exact rate K and the error of each row of a sweep, marked by the narrowest condition that all its checkpoints
    hold.

    The error is that of open-loop simulations, or the one one step ahead if no row has open-loop simulations. Bars:
    from the smallest to the largest rate of the seeds, and the deviation of their errors. The line: the least error at
    a rate up to K.

    Args:
        rows: see `certify.analysis.sweep_rows.rows`; those without the error have no mark, and are counted.

    Returns:
        A matplotlib figure.

    Raises:
        CertifyError: matplotlib is not installed, or no row has an error.

    >>> row = {"jobs": ["0"], "settings": {"dt": "0.4"}, "network": "rnn", "sets": 1, "certified": {"tight": 1},
    ...        "holds": True, "rate": 0.9, "rates": [0.9], "free": 0.1, "free_deviation": None, "mae": 0.02}
    >>> sweep_figure([row]).axes[0].get_ylabel()
    'MAE of open-loop simulations, m/s'
    """
    kind = "free" if any(row["free"] is not None for row in rows) else "mae"
    shown = [row for row in rows if row[kind] is not None]
    if not shown:
        raise CertifyError(
            "--plot: found no errors of these networks in results.json, expected open-loop simulations or MAE: let "
            "jobs finish"
        )
    figure = blank("the figure of a sweep", figsize=(10.2, 5.6), dpi=DPI)
    axes = figure.add_axes((0.075, 0.1, 0.57, 0.79))
    edge = min(GREATEST, 1.06 * max(1.0, *(row["rate"] for row in shown)))
    axes.set(
        xlim=(-0.03 * edge, edge * 1.02),
        xlabel="exact rate K of contraction a step, the largest of the boats and seeds",
    )
    axes.set_ylabel("MAE of open-loop simulations, m/s" if kind == "free" else "MAE one step ahead, m/s")
    _scale(axes, shown, kind)
    _limits(axes, edge)
    places = _places(axes, shown, kind, edge)
    line = _front(shown, kind)
    front = [place for place in places if any(row in line for row in place.rows)]
    _draw(axes, shown, kind, edge)
    axes.step(
        [*(min(row["rate"], edge) for row in line), edge * 1.02], [*(row[kind] for row in line), line[-1][kind]],
        where="post", color=INK, linewidth=0.9, zorder=3, label="least error at a rate up to K",
    )  # fmt: skip
    names = sorted({row["network"] for row in rows})
    axes.set_title(
        _plain(f"Stability against accuracy: {', '.join(names)}"), loc="left", color=INK, fontsize=11, pad=22
    )
    axes.legend(loc="upper left", bbox_to_anchor=(1.03, 1.0), frameon=False, fontsize=POINT + 0.5, borderaxespad=0,
                title="all its checkpoints are certified by", alignment="left", title_fontsize=POINT + 0.5)  # fmt: skip
    _label(axes, places if len(places) <= LABELLED else front, places)
    beyond = sum(row["rate"] > edge for row in shown)
    notes = [f"rows without this error, which are not drawn: {len(rows) - len(shown)}"] * (len(rows) > len(shown))
    notes += [f"rows with K above {edge:g}, at the right edge: {beyond}"] * (beyond > 0)
    _list(axes, sorted(front, key=lambda each: each.y)[:LISTED], kind, len(names) > 1, notes)
    return figure


def _scale(axes, rows: Sequence[Mapping[str, Any]], kind: str) -> None:
    """The error axis: logarithmic where the errors differ by more than a factor of three."""
    errors = [row[kind] for row in rows]
    low, high = (pick(end for row in rows for end in _bar(row, kind)) for pick in (min, max))
    if high > 3 * min(errors) > LEAST:
        bottom, top = max(low, min(errors) / 2) / 1.2, high * 1.2
        decades = range(math.floor(math.log10(bottom)), math.ceil(math.log10(top)) + 1)
        digits = (1, 2, 3, 5) if top < 100 * bottom else (1,)
        ticks = [m * 10.0**k for k in decades for m in digits if bottom <= m * 10.0**k <= top]
        axes.set(yscale="log", ylim=(bottom, top))
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    else:
        room = 0.12 * (high - low) or 0.1 * high or 1.0
        axes.set_ylim(low - room, high + room)
    axes.tick_params(labelsize=POINT + 0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#EEEEEE", linewidth=0.8)
    axes.set_axisbelow(True)


def _bar(row: Mapping[str, Any], kind: str) -> tuple[float, float]:
    """The error of a row less and plus its deviation, which is above 0 for several seeds."""
    deviation = row[f"{kind}_deviation"] or 0.0
    return max(row[kind] - deviation, 0.0), row[kind] + deviation


def _limits(axes, edge: float) -> None:
    """The rates that a condition cannot reach, and the rates that no condition without a box certifies."""
    axes.axvspan(1.0, edge * 1.02, color="#F3F3F3", zorder=0)
    for name, rate in LIMITS.items():
        axes.axvline(rate, color=TIER_COLOURS[name], linewidth=1.2, dashes=(4, 3), zorder=1)
        text = {"simple": "simple < ¼", "lmi": "gershgorin, lmi < ½", "tight": "tight < 1"}[name]
        side = "right" if edge < 1.2 and name == "tight" else "center"
        axes.annotate(text, (rate, 1), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points",
                      ha=side, va="bottom", fontsize=POINT, color=INK)  # fmt: skip


def _draw(axes, rows: Sequence[Mapping[str, Any]], kind: str, edge: float) -> None:
    """A mark for each row, with bars over seeds; a legend entry for each verdict."""
    for verdict, marker in MARKERS.items():
        some = [row for row in rows if narrowest(row) == verdict]
        if not some:
            continue
        colour = "white" if verdict is None else TIER_COLOURS[verdict]
        for row in some:
            x, y = min(row["rate"], edge), row[kind]
            axes.plot([x, x], _bar(row, kind), color=BAR, linewidth=1.0, zorder=2)
            axes.plot([min(*row["rates"], x), x], [y, y], color=BAR, linewidth=1.0, zorder=2)
        axes.plot(
            [min(row["rate"], edge) for row in some], [row[kind] for row in some], linestyle="none", marker=marker,
            markersize=8.5, markerfacecolor=colour, markeredgecolor=INK, markeredgewidth=0.8, zorder=5,
            label=f"{verdict or 'no condition'}: {len(some)}", clip_on=False,
        )  # fmt: skip


def _places(axes, rows: Sequence[Mapping[str, Any]], kind: str, edge: float) -> list[Place]:
    """The rows by the places where they are drawn: those that cover each other are one place."""
    places: list[tuple[Any, Place]] = []
    for row in rows:
        x, y = min(row["rate"], edge), row[kind]
        pixel = axes.transData.transform((x, y))
        near = next((place for at, place in places if math.dist(at, pixel) < NEAR), None)
        if near is None:
            places.append((pixel, Place(x, y, [row])))
        else:
            near.rows.append(row)
    return [place for _, place in places]


def _front(rows: Sequence[Mapping[str, Any]], kind: str) -> list[Mapping[str, Any]]:
    """The rows of which no other has both a rate and an error that are smaller or equal, by rate."""
    found: list[Mapping[str, Any]] = []
    for row in sorted(rows, key=lambda row: (row["rate"], row[kind])):
        if not found or row[kind] < found[-1][kind]:
            found.append(row)
    return found


def _label(axes, labelled: Sequence[Place], places: Sequence[Place]) -> None:
    """Write the jobs of places beside them: a label covers no mark and no other label, and no other mark is nearer.

    A place without room has no label.
    """
    marks = [tuple(axes.transData.transform((each.x, each.y))) for each in places]
    taken = [_box(mark, 14, 14) for mark in marks]
    frame = axes.get_window_extent()
    for place in labelled:
        text, (x, y) = _jobs(place), axes.transData.transform((place.x, place.y))
        width, height = 0.62 * POINT * DPI / 72 * len(text), 1.3 * POINT * DPI / 72
        for dx, dy in _directions(width, height):
            middle = x + dx, y + dy
            box = _box(middle, width, height)
            inside = frame.x0 <= box[0] and box[2] <= frame.x1 and frame.y0 <= box[1] and box[3] <= frame.y1
            own = math.hypot(dx, dy) <= min(math.dist(middle, mark) for mark in marks) + 1e-9
            if inside and own and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                at = axes.transData.inverted().transform(middle)
                axes.text(*at, _plain(text), ha="center", va="center", fontsize=POINT, color=INK, zorder=4,
                          bbox={"color": "white", "alpha": 0.7, "pad": 0.3})  # fmt: skip
                break


def _jobs(place: Place) -> str:
    names = [", ".join(ranges(row["jobs"])) for row in place.rows]
    return names[0] if len(names) == 1 else f"{names[0]} +{len(names) - 1}"


def _plain(text: str) -> str:
    """Text from a file, which matplotlib shall not read as a formula."""
    return text.replace("$", r"\$")


def _directions(width: float, height: float) -> Iterator[tuple[float, float]]:
    """Offsets of a label's middle, pixels: the corners, which bars and the line leave free, the sides, then farther."""
    for far in (1.0, 1.8, 2.8):
        x, y = width / 2 + 8 * far, height / 2 + 7 * far
        yield from ((x, y), (-x, -y), (x, -y), (-x, y))
        yield from ((x, 0), (-x, 0), (0, y), (0, -y))


def _box(middle, width: float, height: float) -> tuple[float, float, float, float]:
    x, y = middle
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _overlap(one, other) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _list(axes, front: Sequence[Place], kind: str, several: bool, notes: Sequence[str]) -> None:
    """The rows on the line, the most accurate first, beside the axes."""
    keys = ", ".join(short_keys(next((p.rows[0]["settings"] for p in front if p.rows[0]["settings"]), {})))
    lines = ["On the line, the most accurate first", f"job: {keys}" if keys else "job", ""]
    for place in front:
        row = place.rows[0]
        more = f" (and {len(place.rows) - 1} more here)" if len(place.rows) > 1 else ""
        what = [row["network"]] * several + [short_values(row["settings"])] * bool(keys)
        text = f"{', '.join(ranges(row['jobs']))}: {', '.join(what)}"
        lines.append(f"{text if len(text) <= WIDTH else text[: WIDTH - 1] + '…'}{more}")
        lines.append(f"      {row[kind]:.3g} m/s, K = {above(row['rate'], 4)}")
    text = _plain("\n".join([*lines, *notes]))
    axes.text(1.03, 0.0, text, transform=axes.transAxes, ha="left", va="bottom", fontsize=POINT, color=INK,
              linespacing=1.35)  # fmt: skip
