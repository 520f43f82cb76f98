"""What TensorBoard shows of tracks: position errors and ellipses by horizon, over the last steps and at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, HEADING_ERROR, HELD_RATE, RADIUS, RHO
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.evaluation.tracks import FEWEST

POSITION, INSIDE = "position error", "coverage of the ellipses of 90 %"
MEANS = (ERROR, CONSTANT, HELD_RATE, HEADING_ERROR)
COLUMNS = len(MEANS) + 3  # sums, then the counts of tracks, of known ellipses, and of positions inside
RESULTS = {  # of `usvlearn.evaluation.tracks.track_scores` -> name, unit, whether it is shown with `log: main`
    "position": (POSITION, " (m)", True), "inside": (INSIDE, "", True),
    "position_constant_turn": (f"{POSITION} of a constant turn", " (m)", False),
    "position_held_rate": (f"{POSITION} with held yaw rate", " (m)", False),
    "heading": ("heading error", " (rad)", False), "radius": ("median radius of the ellipses", " (m)", False),
    "count": ("tracks", "", False),
}  # fmt: skip


class TrackCurves:
    """The curves of tracks by horizon.

    Args:
        horizons: s; none without tracks.
        output: the combiner that predicts, in whose run the curves are.
        names: of the ensemble; the run of persistence, if there is one, has the errors of the constant turn.
    """

    def __init__(self, horizons: Sequence[float], output: str, names: Sequence[str]):
        self.horizons, self.width = tuple(horizons), COLUMNS * len(horizons)
        self.places: list[tuple[str, str]] = []  # run and tag of each of `numbers`
        for h in self.horizons:
            position, inside = tag(POSITION, h, " (m)"), tag(INSIDE, h)
            of_turn = (PERSISTENCE, f"1 tracks/{position}")
            if PERSISTENCE not in names:
                of_turn = output, f"9 all/{tag(RESULTS['position_constant_turn'][0], h, ' (m)')}"
            self.places += [
                (output, f"1 tracks/{position}"),
                of_turn,
                (output, f"9 all/{tag(RESULTS['position_held_rate'][0], h, ' (m)')}"),
                (output, f"9 all/{tag(RESULTS['heading'][0], h, ' (rad)')}"),
                (output, f"1 tracks/{inside}"),
            ]

    def sums(self, published: Mapping[str, np.ndarray], boats: int) -> np.ndarray:
        """Of a stretch: per horizon the sums of errors and the counts, `(boats, width)`.

        >>> due = np.full((1, 1, 8), np.nan)
        >>> due[0, 0, [ERROR, RHO, RADIUS]] = 0.5, 0.4, 0.6
        >>> TrackCurves([2.0], "ensemble", ["ensemble"]).sums({"tracks": due}, 1)
        array([[0.5, 0. , 0. , 0. , 1. , 1. , 1. ]])
        """
        if not self.horizons or "tracks" not in published:
            return np.zeros((boats, self.width))
        rows = published["tracks"].reshape(-1, boats, len(self.horizons), DUE)
        made = np.isfinite(rows[..., ERROR])
        known = made & np.isfinite(rows[..., RADIUS])
        inside = known & (rows[..., RHO] <= rows[..., RADIUS])
        parts = [np.nansum(np.where(made, rows[..., k], 0.0), 0) for k in MEANS]
        return np.stack([*parts, *(x.sum(0) for x in (made, known, inside))], -1).reshape(boats, self.width)

    def numbers(self, sums: np.ndarray) -> np.ndarray:
        """The numbers of `places` from sums of stretches, `(boats, places)`; NaN where fewer than FEWEST became due."""
        *errors, made, known, inside = np.moveaxis(sums.reshape(len(sums), len(self.horizons), COLUMNS), -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = [np.where(made >= FEWEST, each / made, np.nan) for each in errors]
            share = np.where(known >= FEWEST, inside / known, np.nan)
        return np.stack([*means, share], -1).reshape(len(sums), -1)


def result_scalars(
    tracks: Mapping[str, Mapping[str, Mapping[str, Any]]] | None, everything: bool
) -> Iterator[tuple[str, dict[str, float]]]:
    """Each boat, and the scores of its tracks over the whole run by tag.

    Args:
        tracks: of `results.json`; None without.
        everything: whether all scores are shown.

    >>> found = {"heron": {"10": {"position": 1.5, "inside": None, "heading": 0.1}}}
    >>> list(result_scalars(found, False))
    [('heron', {'8 results/position error, 10 s ahead (m)': 1.5})]
    """
    for boat, rows in (tracks or {}).items():
        row = {
            f"8 results/{tag(name, float(horizon), unit)}": each[key]
            for key, (name, unit, main) in RESULTS.items()
            for horizon, each in rows.items()
            if (main or everything) and each.get(key) is not None
        }
        if row:
            yield boat, row


def tag(name: str, horizon: float, unit: str = "") -> str:
    """The part of a tag after its group.

    >>> tag(POSITION, 5.2, " (m)")
    'position error, 5.2 s ahead (m)'
    """
    return f"{name}, {horizon:g} s ahead{unit}"
