"""The commands `usvlearn warm` and `usvlearn live warm`: compile all that is needed, ahead of the first run; no torch.

The second one compiles what a live node needs, which is less.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from usvlearn.errors import complain


def warm(live: bool = False) -> Path:
    """Compile what is not compiled yet, the simulator only with torch; returns the folder of the code."""
    from usvlearn.core.jit import folder
    from usvlearn.core.prepared_samples import ROW
    from usvlearn.engine import dispatch
    from usvlearn.engine.first_use import compile_planar, compile_plans
    from usvlearn.engine.open_loop_scores import compile_free_runs
    from usvlearn.logs.alignment.align import Aligner
    from usvlearn.logs.channels.channel import REQUIRED, Source
    from usvlearn.model.fit import turning
    from usvlearn.model.fit.gauss_newton import compile_fit

    Aligner({name: Source(name) for name in REQUIRED})
    if not live and importlib.util.find_spec("torch") is not None:
        from usvlearn.simulate.fleet import fleet

        fleet(n=1, hours=0.01)
    compile_plans(dtype := np.dtype(float))
    compile_planar(dtype)
    if not live:
        compile_free_runs(dtype)
    compile_fit()
    turning.evaluate(turning.MEAN, [np.empty((0, ROW))])
    return folder(Path(dispatch.__file__)).parent


def main() -> int:
    """The command `usvlearn warm`; returns the exit code."""
    return _command(sys.argv[1:], "usvlearn warm", live=False)


def warm_live(arguments: Sequence[str]) -> int:
    """The command `usvlearn live warm`; returns the exit code."""
    return _command(list(arguments), "usvlearn live warm", live=True)


def _command(arguments: list[str], name: str, live: bool) -> int:
    if arguments in (["-h"], ["--help"]):
        print(f"usage: {name}")
        return 0
    if arguments:
        complain(f"error: found {' '.join(arguments)!r}, expected nothing: usage: {name}")
        return 2
    kept = warm(live)
    print(f"usvlearn: everything is compiled; it is kept in {kept}")
    if kept.is_relative_to(tempfile.gettempdir()):
        complain("warning: a restart of the computer empties this folder: set NUMBA_CACHE_DIR to another")
    return 0
