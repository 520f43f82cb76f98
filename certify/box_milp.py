"""The exact rate on a box as a mixed-integer linear program, solved by HiGHS: a referee of `certify.box_search`.

Its upper bound is a claim in floating point, which nothing here proves.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Iterator

import numpy as np

from certify.box_cells import inner_point
from certify.box_planes import Box
from certify.box_search import CLIMBERS, Forms, Search, climb, slopes_at


def solve_milp(forms: Forms, box: Box, gap: float, end: float) -> tuple[float, np.ndarray | None, int]:
    """max |slope| by HiGHS: its upper bound, a claim in floating point; the best point; the nodes.

    d_g = 1 where z_g > 0. Only what raises the slope needs a constraint: z_g ≥ L_g (1 − d_g), or z_g ≤ U_g d_g. A
    solution whose cell is only touched is cut off: of the signs that exclude each other, one must change.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    H, c, _, gain, start, _, slack, _ = forms
    rng = np.random.default_rng(0)
    search = Search(lambda best: best, math.inf, end)
    search.reached(*climb(forms, box, rng.uniform(box.lo, box.hi, (CLIMBERS, len(box.lo)))))
    active = np.flatnonzero(gain)
    radius = (box.hi - box.lo) / 2
    rho = np.abs(H[active]) @ radius
    rows, z = H[active] * radius / rho[:, None], (H[active] @ ((box.lo + box.hi) / 2) + c[active]) / rho
    upper, nodes = 0.0, 0
    for up in (True, False):
        reward = gain[active] if up else -gain[active]
        first = start if up else -start
        wanted = 1 if up else -1
        big = z - wanted  # the bound on the side that is not wanted
        A, least = np.c_[wanted * rows, np.diag(big)], np.full(len(z), -1.0) if up else z
        limits = Bounds(np.r_[-np.ones(len(radius)), 0 * z], np.ones(len(radius) + len(z)))
        while True:
            left = end - time.perf_counter()
            best = first + np.maximum(reward, 0).sum()  # where no bound is known
            if not len(active) or left <= 0:
                break
            with _quiet():
                solved = milp(
                    np.r_[0 * radius, -reward],
                    integrality=np.r_[0 * radius, 1 + 0 * z],
                    bounds=limits,
                    constraints=LinearConstraint(A, least, np.inf),
                    options={"time_limit": left, "mip_rel_gap": gap / 4},
                )
            nodes += int(solved.get("mip_node_count") or 1)
            if solved.get("mip_dual_bound") is not None and np.isfinite(solved.mip_dual_bound):
                best = min(best, first - solved.mip_dual_bound)
            if solved.x is None:
                break
            on = solved.x[len(radius) :] > 0.5
            held = on == up
            parted = tuple((g, wanted) for g in active[held].tolist())
            y, mu = inner_point(forms, box.lo, box.hi, parted, rng)
            if y is not None:
                search.reached(slopes_at(forms, (H @ y + c)[None]), y[None])
            if not mu:
                break
            cut = np.isin(active, list(mu))
            A = np.r_[A, np.r_[0 * radius, -wanted * cut][None]]
            least = np.r_[least, 1.0 - up * cut.sum()]
        upper = max(upper, best + slack)
    return upper, search.point, nodes


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing reaches standard output: HiGHS prints there from C (ERGO-Code/HiGHS#2783)."""
    import ctypes
    import sys

    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        with contextlib.suppress(OSError, TypeError):
            ctypes.CDLL(None).fflush(None)  # what C has buffered
        os.dup2(kept, 1)
        os.close(kept)
