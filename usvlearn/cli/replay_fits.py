"""A replay in which the batch fit of the missions so far joins the forecasts, as in a node (`refit=true`).

The replay waits for each fit, which depends on the logs alone: a run that was resumed equals one that was not. Of many
missions a fit is made where they are a quarter more, so that all fits take a few times as long as the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig

from usvlearn.estimators.ensemble.forecasts.state import TABLE

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.logs.channels.channel import Recording
    from usvlearn.runs.prediction_files import Position
    from usvlearn.runs.replay import Chunk
    from usvlearn.runs.run_folder import RunFolder

MORE = 1.25  # times the missions of a fit are those of the next
FITTED = "usvlearn.estimators.ensemble.forecasts.fit_layer.FittedForecasts"


def takes_fits(ensemble: Ensemble) -> bool:
    """Whether a fit can join its forecasts: a joint EKF is weighed, and compiled code makes all steps."""
    from usvlearn.engine.backend import description_of
    from usvlearn.estimators.joint.layer import JointEKF

    weighed = [] if ensemble.forecasts is None else [ensemble.members[name] for name in ensemble.forecasts.names]
    joint = any(isinstance(each, JointEKF) for each in weighed)
    return joint and description_of(ensemble, None, "auto") is not None


def replay_with_fits(
    run: RunFolder, begin: Position, fits: Callable[[int], np.ndarray], every: int, save_every: int
) -> Iterator[Chunk]:
    """`usvlearn.runs.replay.replay` of a run's folder, to which each chunk is saved before the next one is made."""
    from usvlearn.engine.backend import arrays_of, tree_of
    from usvlearn.engine.fit_member import with_fit
    from usvlearn.runs.replay import replay

    fleet, ends, k = run.fleet, list[int](), 1
    ensemble: Any = run.ensemble
    while k < len(fleet.runs):
        ends.append(k)
        k = max(k + 1, int(MORE * k))
    done = [k for k in ends if (k - 1, len(fleet.runs[k - 1].time)) < begin]
    if done:
        ensemble.forecasts.fit = fits(done[-1])
    for k in [*ends[len(done) :], len(fleet.runs)]:
        part = fleet._replace(runs=fleet.runs[:k])
        for chunk in replay(ensemble, part, run.state, begin, every, save_every, run.planar, run.beside):
            yield chunk
            begin = chunk.end
        if k < len(fleet.runs):
            table = fits(k)
            leaves, _ = with_fit(arrays_of(run.state), ensemble.description(), table)
            run.state, ensemble.forecasts.fit = tree_of(run.state, leaves), table


def fits_of(run: RunFolder, recordings: Sequence[Recording], cfg: DictConfig) -> Callable[[int], np.ndarray]:
    """Tables of the fits to the first runs of each boat, `(boats, TABLE)`; zeros where there are too few steps, or the
    fit is doubted.
    """
    from usvlearn.evaluation.diagnostics import events
    from usvlearn.logs.recordings import align_fleet
    from usvlearn.model.fit.fitted import fit_boat
    from usvlearn.model.fit.hand_over import table_of
    from usvlearn.model.fit.logs import fine, missions_of, without_losses

    fleet, whole = run.fleet, align_fleet(recordings, **fine(cfg.align))

    def table(boat: str, runs: int, happened: Sequence[Any]) -> Any:
        later = {each.names[fleet.boats.index(boat)] for each in fleet.runs[runs:]}
        first = tuple(each for each in whole.runs if each.names[whole.boats.index(boat)] not in later)
        try:
            rows = without_losses(boat, missions_of(whole._replace(runs=first), boat), happened, tell=False)
            fitted = fit_boat(boat, rows, float(cfg.vehicle.mass), float(cfg.vehicle.surge_max))
        except (ValueError, ArithmeticError):  # the fit at the end of the run tells it
            return np.zeros(TABLE)
        return np.zeros(TABLE) if fitted.doubts else table_of(fitted)

    def fits(runs: int) -> np.ndarray:
        published = (each for each in run.published.only("thrusters", "health") if each[0] < runs)
        happened = events(fleet, published, run.ensemble.accommodated)
        return np.array([table(boat, runs, happened[boat]) for boat in fleet.boats])

    return fits
