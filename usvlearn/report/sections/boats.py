"""Cross-validation between boats: the best checkpoint of each on the runs of all (paper, figure 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.display.result_table import ResultTable
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.season_figures import matrix_figure
from usvlearn.report.sections.section import Drawn, Section, on

PAPER_RESULT = (
    "The MSE of AVE with the best checkpoint of each boat on the runs of all boats, which had started the season "
    "from equal "
    "parameters: the learned models suit the boats on which they were learned (encouraging, in the paper's word), and "
    "show that some have a thruster bias."
)


def best_checkpoints(seasons: Sequence[Season], errors: Mapping[str, FreeErrors], method: str) -> list[int]:
    """Each boat's checkpoint with the least MSE on the boat's other runs, equal weight per step; its last, if it has no
    other.

    Args:
        seasons: of all boats.
        errors: of the checkpoints of each boat on all of its runs.
        method: whose error decides.
    """
    chosen = []
    for season in seasons:
        found = errors[season.boat]
        mse = found.pooled(found.mse, season.others)[:, found.methods.index(method)]
        chosen.append(int(np.nanargmin(mse)) if np.isfinite(mse).any() else len(mse) - 1)
    return chosen


def fleet_matrices(seasons: Sequence[Season], between: Mapping[str, FreeErrors], methods: Sequence[str]):
    """MSE of the best checkpoint of each boat (rows) on all runs of each boat (columns), m²/s², by method.

    Args:
        seasons: of all boats.
        between: of the best checkpoints, in the order of the seasons, on all runs of each boat.
        methods: those to show.
    """
    columns = [between[season.boat].pooled(between[season.boat].mse) for season in seasons]  # (sets, methods) each
    names = between[seasons[0].boat].methods
    return {name: np.stack([column[:, names.index(name)] for column in columns], -1) for name in methods}


def fleet_section(
    seasons: Sequence[Season], matrices: Mapping[str, np.ndarray], best: Mapping[str, Sequence[float]]
) -> Section:
    """The matrices, and how far each boat's own checkpoint is ahead of the others'.

    Args:
        seasons: of all boats.
        matrices: of `fleet_matrices`; the first is the paper's.
        best: hours at which each boat's best checkpoint was saved, by method.
    """
    boats = [season.boat for season in seasons]
    here: list[str] = []
    rows: list[tuple[str | float, ...]] = []
    for name, matrix in matrices.items():
        own = sum(int(np.nanargmin(matrix[:, k]) == k) for k in range(len(boats)) if np.isfinite(matrix[:, k]).any())
        away = matrix[~np.eye(len(boats), dtype=bool)]
        ratio = np.nanmean(away) / np.nanmean(np.diag(matrix))
        here.append(
            f"{name}: {on(own, len(boats))} the boat's own checkpoint is the best; on average another boat's "
            "checkpoint has "
            f"{ratio:.2f} × the MSE of the own checkpoint."
        )
        for boat, row, hours in zip(boats, matrix, best[name], strict=True):
            rows.append((name, boat, hours, *map(float, row)))
    caption = (
        "Row: the boat of the checkpoint. Column: the boat of the runs, all of them, simulated free. The best of "
        "each column "
        "is framed. A boat's best checkpoint has the least MSE of that method on the runs in which it was not saved, "
        "so the "
        "diagonal was chosen on these runs and the rest of a column was not. The ensemble has the weights that it had "
        "when the checkpoint was saved."
    )
    columns = ("method", "best checkpoint of", "saved after, h", *(f"MSE on {boat}, m²/s²" for boat in boats))
    drawn = [Drawn("fleet", matrix_figure(matrices, boats), caption)]
    return Section("fleet", "Between boats", PAPER_RESULT, here, drawn, [ResultTable("fleet", columns, rows)])
