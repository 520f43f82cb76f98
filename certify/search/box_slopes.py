"""Which search `certify.search.box` makes for the greatest slope: over boxes, over cells, or by linear programs.

Boxes are halved fastest (`certify.search.box_search`), but their number grows exponentially with the coordinates d, and
where hyperplanes meet in a point halving would not end. A program's time grows with the G hyperplanes and hardly with
d. The rule is measured (docs/benchmarks/box.md): for d ≥ 6 and G ≤ 2^d few boxes are tried; then the whole box is split
into cells, by linear programs over all of its planes (`certify.search.box_duals`). Where the tree is needed, G ≤ 2^(d +
1), since trees of boxes become too long to replay. Without the package `highspy` the cells are split by
`certify.search.box_cells`, for d ≥ 7 and G ≤ 2^d: what is proved is as true, but the gap is wider, or is closed later.
"""

from __future__ import annotations

import math

import numpy as np

from certify.proofs.box_planes import Box
from certify.search.box_cells import search_cells
from certify.search.box_duals import installed, search_duals
from certify.search.box_search import BOXES, CLIMBERS, LEFT, Forms, Search, climb, slope_bounds

FEW_BOXES = 500  # boxes tried before cells, if there are many inputs
CELLED = 30  # hyperplanes up to which the cells of a whole box are tried
SMALL = 2.0**-16  # share of the whole box's width down to which boxes are halved
MANY = 7  # free coordinates from which on cells are better than boxes
PROGRAMS = 6  # and from which on programs are


def search_slopes(search: Search, forms: Forms, box: Box, most: int) -> None:
    """Search max |slope|: at most `most` boxes, then the cells of the open boxes, or of the whole box.

    Args:
        search: what is known; it receives the tree, the best point and the bounds.
        forms: the planes, over any number of coordinates.
        box: of these coordinates.
        most: boxes tried.
    """
    G, rng = len(forms.c), np.random.default_rng(0)
    bound, halve = slope_bounds(forms)
    search.reached(*climb(forms, box, rng.uniform(box.lo, box.hi, (CLIMBERS, len(box.lo)))))
    free = int((box.lo < box.hi).sum())
    programs = programs_are_better(free, G, search.proof) and installed()
    many = programs or (free >= MANY and G <= 2**free)
    most = min(most, FEW_BOXES if many else min(BOXES, 16 << min(G, 20)) if G <= CELLED else most)
    queue = search.boxes(bound, halve, lambda y: climb(forms, box, y), box, G, most, SMALL)
    search.open = queue[0].max(initial=-math.inf)
    if not len(queue[0]) or search.over():
        return
    if len(queue[0]) > LEFT:
        search.restart()
        if programs and search_duals(search, forms, box, rng):
            return
        signs = np.zeros((1, G), np.int8)
        queue = [np.full(1, search.limit), box.lo[None], box.hi[None], signs, np.zeros(1, np.int64)]
    search_cells(search, forms, queue, rng)


def programs_are_better(coordinates: int, hyperplanes: int, proof: bool) -> bool:
    """Whether a whole box is split into cells by linear programs, after a few boxes.

    >>> programs_are_better(5, 20, True), programs_are_better(6, 100, True), programs_are_better(6, 100, False)
    (False, True, False)
    """
    return coordinates >= PROGRAMS and hyperplanes <= 2 ** (coordinates + proof)
