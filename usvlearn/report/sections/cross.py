"""Cross-validation: every checkpoint on its boat's other runs, the best on all boats' (paper, figures 4 and 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, PAPER, guarded, panels_of
from usvlearn.display.terminal import ResultTable
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.evaluation.metrics import by_error
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.errors import Box, box, boxes_figure
from usvlearn.report.sections.section import WORSE, Drawn, Section, mean_errors, on, summary, tally

PAPER_RESULT = (
    "43 to 82 saved checkpoints per boat. AID had the lowest error on seven of eight boats and the smallest range on "
    "six; RNN and RLS had many outliers; AVE was no better than AID; the RLS-weighted ensemble, whose weights were "
    "learned offline, step by step as if online, was better than all of them."
)

SEES = "sees the speed"  # of NAME+
BETWEEN_RESULT = (
    "The MSE of AVE with the best checkpoint of each boat on the runs of all boats, which had started the season from "
    "equal parameters: the learned models suit the boats on which they were learned (encouraging, in the paper's "
    "word), and show that some have a thruster bias."
)


def cross_section(
    seasons: Sequence[Season], errors: Mapping[str, FreeErrors], remarks: Mapping[str, str] | None = None
) -> Section:
    """The distribution of the open-loop MAE over (checkpoint, other run), per boat and method."""
    boxes: dict[str, dict[str, Box | None]] = {}
    subtitles, rows, remarks = {}, [], dict(remarks or {})
    remarks |= {name: SEES for name in errors[seasons[0].boat].methods if name.endswith("+")}
    for season in seasons:
        free, others = errors[season.boat], season.others & (errors[season.boat].steps > 0)
        boxes[season.boat] = {
            name: box(free.mae[..., k][others], int(free.diverged[..., k][others].sum()))
            for k, name in enumerate(free.methods)
        }
        subtitles[season.boat] = f"{len(season.saved_in)} checkpoints × {len(season.runs)} runs"
        for name in by_error({name: each and each.mean for name, each in boxes[season.boat].items()}):
            if (each := boxes[season.boat][name]) is not None:
                later = free.mae[..., free.methods.index(name)][season.later & (free.steps > 0)]
                rows.append((season.boat, name, each.median, each.mean, each.lower, each.upper, each.low, each.high,
                             each.outliers, each.diverged, each.number,
                             float(np.median(later)) if len(later) else None,
                             remarks.get(name, "")))  # fmt: skip
    if not rows:
        here = ["There is no other run to simulate: each boat has one, from which all of its checkpoints came."]
        return Section("crossval", "Cross-validation", PAPER_RESULT, here)
    columns = ("boat", "method", "median MAE, m/s", "mean, m/s", "lower quartile, m/s", "upper quartile, m/s",
               "5 %, m/s", "95 %, m/s", "outliers", "diverged", "simulations",
               "median over later runs, m/s", "remark")  # fmt: skip
    caption = (
        "Every saved checkpoint is simulated on every run of its boat except the one in which it was saved. A "
        "simulation uses the inputs, and the speed at which each segment starts. Some of these runs were learned "
        "before the checkpoint was saved; the table also has the median over later runs only. The lowest mean over "
        "boats comes first. Box: quartiles of the MAE; line: 5 to 95 %; diamond: mean; dots: beyond; div.: simulations "
        "that left the physical limit, which count with the error of the limit. NAME+ (hollow) weighs the free members "
        "by the speeds measured so far: it sees the speed. Outliers in the table lie more than 1.5 quartile distances "
        "above the box."
    )
    simulated = {boat: {name: each for name, each in row.items() if each is not None} for boat, row in boxes.items()}
    known = {boat: row for boat, row in simulated.items() if len(row) == len(boxes[boat])}
    means = {boat: {name: each.mean for name, each in row.items()} for boat, row in known.items()}
    order = by_error(mean_errors(means))  # of all panels
    boxes = {boat: {name: row[name] for name in order} for boat, row in boxes.items()}
    return Section(
        "crossval",
        "Cross-validation: open-loop simulations of every saved checkpoint",
        PAPER_RESULT,
        _findings(known),
        [Drawn("crossval", boxes_figure(boxes, subtitles, "MAE of an open-loop simulation, m/s"), caption)],
        [
            summary("crossval_fleet", means, "MAE of an open-loop simulation, m/s", remarks),
            ResultTable("crossval", columns, rows),
        ],
    )


def _findings(boats: Mapping[str, Mapping[str, Box]]) -> list[str]:
    names, count = list(next(iter(boats.values()))), len(boats)
    three = [name for name in PAPER if name in names]
    here = []
    if len(three) > 1:
        best = [by_error({name: row[name].mean for name in three})[0] for row in boats.values()]
        here.append(tally("lowest mean", three, best))
        best = [by_error({name: row[name].high - row[name].low for name in three})[0] for row in boats.values()]
        here.append(tally("smallest range (5 to 95 %)", three, best))
    if {"average", "aid"} <= set(names):
        here.append(f"The average beats AID {on(_less(boats, 'average', ['aid']), count)}.")
    for name in ("weighted", "weighted+"):
        if name in names and three:
            how = "that continue to learn from the measured speed" if name.endswith("+") else "as they were saved"
            here.append(
                f"The RLS-weighted ensemble, with weights {how}, beats all of {', '.join(three)} "
                f"{on(_less(boats, name, three), count)}."
            )
    free = [name for name in names if not name.endswith("+")]
    means = {name: float(np.mean([row[name].mean for row in boats.values()])) for name in free}
    best = sorted(means, key=means.__getitem__)[:3]
    here.append(
        "Lowest of all open-loop simulations, mean over boats: "
        + ", ".join(f"{n} {means[n]:.3f} m/s" for n in best)
        + "."
    )
    diverged = {name: sum(row[name].diverged for row in boats.values()) for name in names}
    total = sum(row[names[0]].number for row in boats.values())
    bad = ", ".join(f"{name} {number}" for name, number in diverged.items() if number)
    here.append(f"Diverged, of {total} simulations per method: {bad or 'none'}.")
    return here


def _less(boats: Mapping[str, Mapping[str, Box]], name: str, others: Sequence[str]) -> int:
    return sum(all(row[name].mean < row[other].mean for other in others) for row in boats.values())


def best_checkpoints(seasons: Sequence[Season], errors: Mapping[str, FreeErrors], method: str) -> list[int]:
    """Each boat's checkpoint with the least MSE on its other runs, by steps; its last without another run."""
    chosen = []
    for season in seasons:
        free = errors[season.boat]
        mse = free.pooled(free.mse, season.others)[:, free.methods.index(method)]
        chosen.append(int(np.nanargmin(mse)) if np.isfinite(mse).any() else len(mse) - 1)
    return chosen


def fleet_matrices(seasons: Sequence[Season], between: Mapping[str, FreeErrors], methods: Sequence[str]):
    """MSE of the best checkpoint of each boat (rows) on all runs of each boat (columns), m²/s², by method."""
    columns = [between[each.boat].pooled(between[each.boat].mse) for each in seasons]  # (checkpoints, methods) each
    names = between[seasons[0].boat].methods
    return {name: np.stack([column[:, names.index(name)] for column in columns], -1) for name in methods}


def fleet_section(
    seasons: Sequence[Season], matrices: Mapping[str, np.ndarray], best: Mapping[str, Sequence[float]]
) -> Section:
    """The matrices, the paper's first, and how far each boat's own checkpoint is ahead of the others'."""
    boats = [season.boat for season in seasons]
    here: list[str] = []
    rows: list[tuple[str | float, ...]] = []
    for name, matrix in matrices.items():
        count = sum(int(np.nanargmin(matrix[:, k]) == k) for k in range(len(boats)) if np.isfinite(matrix[:, k]).any())
        away = matrix[~np.eye(len(boats), dtype=bool)]
        ratio = np.nanmean(away) / np.nanmean(np.diag(matrix))
        here.append(
            f"{name}: {on(count, len(boats))} the boat's own checkpoint is the best; on average another boat's "
            f"checkpoint has {ratio:.2f} × the MSE of the own checkpoint."
        )
        for boat, row, hours in zip(boats, matrix, best[name], strict=True):
            rows.append((name, boat, hours, *map(float, row)))
    caption = (
        "Row: the boat of the checkpoint. Column: the boat of the runs, all of them, simulated free. The best of each "
        "column is framed. A boat's best checkpoint has the least MSE of that method on the runs in which it was not "
        "saved, so the diagonal was chosen on these runs and the rest of a column was not. The ensemble has the "
        "weights that it had when the checkpoint was saved."
    )
    columns = ("method", "best checkpoint of", "saved after, h", *(f"MSE on {boat}, m²/s²" for boat in boats))
    drawn = [Drawn("fleet", matrix_figure(matrices, boats), caption)]
    return Section("fleet", "Between boats", BETWEEN_RESULT, here, drawn, [ResultTable("fleet", columns, rows)])


@guarded
def matrix_figure(matrices: Mapping[str, np.ndarray], boats: Sequence[str]):
    """MSE, m²/s², of each boat's checkpoint (rows) on each boat's runs; the least of a column is framed."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import LogLocator

    size = 0.42 * len(boats) + 1.4
    every = np.concatenate([matrix[np.isfinite(matrix) & (matrix > 0)] for matrix in matrices.values()])
    low, high = (every.min(), every.max()) if len(every) else (1e-4, 1.0)
    norm = LogNorm(low, high if high > low else low * 1.01)  # one scale, so that the methods can be compared
    figure, panels = panels_of(len(matrices), 2, (size, size), (0.4, 0.0), shared=False)
    for panel, (name, matrix) in zip(panels, matrices.items(), strict=True):
        image = panel.imshow(np.where(matrix > 0, matrix, np.nan), norm=norm, cmap="cividis", aspect="equal")
        for (row, column), value in np.ndenumerate(matrix):
            dark = not np.isfinite(value) or value <= 0 or norm(value) < 0.55
            text = "–" if not np.isfinite(value) else f"{1000 * value:.3g}"
            style = {"ha": "center", "va": "center", "fontsize": 7.5, "color": "white" if dark else "#010101"}
            panel.text(column, row, text, **style)
        for column in range(matrix.shape[1]):
            if np.isfinite(matrix[:, column]).any():
                best = int(np.nanargmin(matrix[:, column]))
                frame: dict[str, Any] = {"fill": False, "edgecolor": WORSE, "linewidth": 1.8}
                panel.add_patch(Rectangle((column - 0.47, best - 0.47), 0.94, 0.94, **frame))
        panel.set_xticks(range(len(boats)), boats, rotation=45, ha="right", rotation_mode="anchor")
        panel.set_yticks(range(len(boats)), boats)
        panel.tick_params(length=0)
        panel.grid(False)
        panel.spines[:].set_visible(False)
        panel.set(title=name, xlabel="runs of", ylabel="best checkpoint of")
    bar = figure.colorbar(image, ax=panels, shrink=0.75, ticks=LogLocator(subs=(1, 2, 5)))
    bar.ax.yaxis.set_major_formatter(lambda x, _: f"{1000 * x:g}")
    bar.ax.minorticks_off()
    bar.set_label("MSE, 10⁻³ m²/s²", color=INK)
    bar.outline.set_visible(False)
    return figure
