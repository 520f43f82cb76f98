"""The gap of the exact rate on a box, by neurons and inputs, with and without linear programs.

python benchmarks/box.py             writes docs/benchmarks/box.md
"""

import statistics
import time
from types import SimpleNamespace

import numpy as np
from pages import publish

from certify.analysis.families import initial_networks
from certify.proofs.box_proof import proves
from certify.search import box, box_search, box_slopes

SECONDS = 10.0
NETWORKS = 2
SIZES = ((50, 4), (100, 4), (50, 5), (100, 5), (20, 6), (50, 6), (100, 6), (200, 6))
SIZES += ((50, 8), (100, 8), (200, 8), (50, 10), (100, 10))
PAGE = f"""# Exact rates on boxes of many inputs

{NETWORKS} networks of each size, initialised as by torch, on the operating box. A search has {SECONDS:.0f} s of one
processor. *Closed* counts the networks whose exact rate was found. The gap is (upper − lower)/upper. Gaps and times are
means. *With* is the search that may use linear programs, *without* the one where the package `highspy` is missing; both
search each network in turn. A proof is that of a rate 0.1 % above a closed one, found by the first; its replay needs no
solver.

| n | m | without: closed | gap, % | s | with: closed | gap, % | s | proved | replay, s | proof, kB |
|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"""
CLOSING = f"""Linear programs are used from m = {box_slopes.PROGRAMS - 1} on, with at most 2^(m + 1) hyperplanes, or
2^(m + 2) where a proof is asked for; boxes otherwise. In the rows for m ≤ 4 both searches are the same."""


def measured(n: int, m: int) -> str:
    """A row: gap and time of both searches, in turn, network by network, and the proofs of the second."""
    over, found = box.operating_box(m), {"without": [], "with": []}
    installed, proofs = box_slopes.installed, []
    for weights in initial_networks(NETWORKS, n, np.random.default_rng([n, m]), m):
        for name, each in found.items():
            if name == "without":
                box_slopes.installed = lambda: False
            each.append(box.rate(weights, over, seconds=SECONDS))
            box_slopes.installed = installed
        if each[-1].closed:
            asked = 1.001 * each[-1].upper
            verdict = box.certify(weights, over, asked, 2 * SECONDS)
            began = time.process_time()
            if verdict.tree is not None and proves(weights, over, verdict.tree, asked):
                proofs.append((time.process_time() - began, len(verdict.tree) / 1000))
    cells = [str(n), str(m)]
    for each in found.values():
        gaps = [100 * (x.upper - x.lower) / x.upper for x in each]
        took = [x.seconds for x in each]
        cells += [f"{sum(x.closed for x in each)}", f"{statistics.mean(gaps):.1f}", f"{statistics.mean(took):.3g}"]
    replay, size = (statistics.mean(column) for column in zip(*proofs, strict=True)) if proofs else (None, None)
    cells += [f"{len(proofs)}", *((f"{replay:.2g}", f"{size:.3g}") if proofs else ("–", "–"))]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    box.time = box_search.time = SimpleNamespace(perf_counter=time.process_time)  # also where others use the machine
    box.rate(initial_networks(1, 20, np.random.default_rng(0), 6)[0], box.operating_box(6))  # imports
    rows = [measured(n, m) for n, m in SIZES]
    publish(__file__, [*PAGE.splitlines(), *rows, "", *CLOSING.splitlines()])


if __name__ == "__main__":
    main()
