"""All evaluations of a tuning: one file of arrays, a picture, and whether the best setting differs from others.

Two settings are compared by the differences of their errors on each run of each boat, because the difficulty of a run
cancels. A setting is as good as the best if the 95 % interval of the mean difference contains 0. The state goes on from
run to run, so runs are not quite independent, and the interval is somewhat narrow.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core.checkpoint import write_atomically
from usvlearn.display.figures import panels_of, rendered, themed
from usvlearn.errors import MissingExtraError
from usvlearn.evaluation.comparison import quantile
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter

ARRAYS, PICTURE = "evaluations.npz", "landscape.png"
LEAST_RUNS, FLAT = 3, 0.5  # paired runs that tell anything; share of a range, as good as the best, that is flat
CELLS, MOST_PANELS, ACROSS, WORST = 40, 6, 3, 90  # of a map, each way; percentile from which colours are the same


def explore(folder: Path, parameters: Sequence[Hyperparameter], tried: Sequence[Evaluation]) -> dict[str, Any]:
    """Write the arrays, the default first, and with matplotlib the picture; returns what is told, errors in m/s."""
    settings = np.array([[each.setting[one.path] for one in parameters] for each in tried])
    places = np.array([[one.to_scale(x) for one, x in zip(parameters, row, strict=True)] for row in settings])
    maes, known = np.array([each.mae for each in tried]), [each.runs for each in tried if each.runs is not None]
    runs = np.stack(known).reshape(len(tried), -1) if len(known) == len(tried) else np.empty((len(tried), 0))
    folder.mkdir(parents=True, exist_ok=True)
    columns, content = {each.path: column for each, column in zip(parameters, settings.T, strict=True)}, io.BytesIO()
    np.savez(content, mae=maes, runs=runs.astype(np.float32), **columns)
    write_atomically(folder / ARRAYS, content.getvalue())
    with suppress(MissingExtraError):
        write_atomically(folder / PICTURE, _picture(parameters, places[np.isfinite(maes)], maes[np.isfinite(maes)]))
    runs, best = np.where(np.isfinite(runs), runs, np.inf)[:, np.isfinite(runs[maes.argmin()])], maes.argmin()
    if (count := runs.shape[1]) < LEAST_RUNS:
        return {"runs": count, "told": f"Too few runs ({count}) to tell which settings are as good as the best."}
    with np.errstate(invalid="ignore"):  # of infinite differences
        difference = runs - runs[best]
        alike = difference.mean(1) <= quantile(count) * difference.std(1, ddof=1) / np.sqrt(count)
        others = np.where(np.isfinite(runs), runs.sum(1, keepdims=True) - runs, np.inf)
    alike[best] = True
    ranges = {path: [float(x[alike].min()), float(x[alike].max())] for path, x in columns.items()}
    widths = zip(parameters, np.ptp(places[alike], 0), strict=True)
    flat = [each.path for each, width in widths if width > FLAT * (each.span[1] - each.span[0])]
    chosen, default = runs[others.argmin(0), np.arange(count)].mean(), runs[0].mean()
    sentence = (
        f"{alike.sum()} of {len(alike)} settings are as good as the best, as far as {count} runs tell: "
        + ", ".join(f"{path} {low:.4g} … {high:.4g}" for path, (low, high) in ranges.items())
        + f"{'. The optimum is flat in ' if flat else ''}{', '.join(flat)}."
        + f"{' The default is one of them.' if alike[0] else ''} On each run, the setting that is best on the others "
        + f"has {chosen:.5f} m/s on average, the default {default:.5f} m/s."
    )
    return {"runs": count, "alike": int(alike.sum()), "ranges": ranges, "flat": flat, "default_alike": bool(alike[0]),
            "left_out": chosen if np.isfinite(chosen) else None, "told": sentence}  # fmt: skip


def _picture(parameters: Sequence[Hyperparameter], places: np.ndarray, maes: np.ndarray) -> bytes:
    """A PNG: the least error over each pair of hyperparameters, whatever the others are; of one alone a curve."""
    pairs = list(itertools.combinations(range(len(parameters)), 2))[:MOST_PANELS] or [(0, 0)]
    with themed():
        figure, panels = panels_of(len(pairs), ACROSS, (4.8, 3.8), shared=False)
        for panel, pair in zip(panels, pairs, strict=True):
            x, y = places[:, pair].T
            for axis, k in zip((panel.yaxis, panel.xaxis), pair[::-1], strict=True):
                axis.set_major_formatter(lambda x, _, of=parameters[k]: f"{of.from_scale(x):.3g}")
                axis.set_label_text(parameters[k].path)
            if len(parameters) == 1:
                panel.yaxis.set_major_formatter("{x:.4g}")
                panel.plot(*np.array(sorted(zip(x, maes, strict=True))).T, ".-", markersize=3)
                panel.set_ylabel("MAE, m/s")
            elif len(maes):
                from scipy.stats import binned_statistic_2d

                counts: Any = [min(CELLS, len({*each})) for each in (x, y)]
                cells, *ends, _ = binned_statistic_2d(x, y, maes, "min", counts)
                panel.grid(False)
                image = panel.pcolormesh(*ends, cells.T, cmap="cividis", vmax=np.percentile(maes, WORST))
                panel.plot(x[maes.argmin()], y[maes.argmin()], "ow", markeredgecolor="black", clip_on=False)
                figure.colorbar(image, ax=panel, label="MAE, m/s")
        return rendered(figure, facecolor="white")
