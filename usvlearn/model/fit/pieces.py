"""Missions cut in pieces: the units of scatter, of leaving out and of wear, whatever the files are.

Errors of neighbouring steps are alike for some seconds to a minute, hardly those of pieces of `SECONDS`. So one long
log tells as much as many short ones. Each piece has a start and a current of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from usvlearn.core.rows import HOLD, LEARN, MODE, START
from usvlearn.model.fit.gauss_newton import Missions, scored

SECONDS = 150.0  # s
MOST = 200  # pieces of all missions together, about; of longer logs pieces are longer


def cut(missions: Mapping[str, np.ndarray], top: float, dt: float) -> Missions:
    """Missions in pieces that have the names of their missions; pieces without a measured step are left out.

    Args:
        missions: prepared samples by name, `(time, ROW)` each, on a grid of `dt`, s.
        top: top speed, m/s.

    >>> rows = np.tile([0.0] * 5 + [0.1, 1.5, LEARN], (9000, 1))
    >>> cut({"a": rows, "b": rows[:2000]}, 2.0, 0.1).names
    ['a', 'a', 'a', 'a', 'a', 'a', 'b']
    """
    length = max(SECONDS / dt, sum(map(len, missions.values())) / MOST)
    pieces, names = [], []
    for name, rows in missions.items():
        for k, part in enumerate(np.array_split(rows, max(1, round(len(rows) / length)))):
            if scored(part).any():
                pieces.append(_opened(part) if k else part)
                names.append(name)
    return Missions(pieces, top, names)


def _opened(rows: np.ndarray) -> np.ndarray:
    """A piece that starts a segment with its first measured speed, where it has one."""
    rows = rows.copy()
    rows[0, MODE] = START if rows[0, MODE] == LEARN else HOLD
    return rows
