"""The command `usvlearn warm [float32] [readers]`: compile all that is needed, ahead of the first run; without torch.

`usvlearn live warm` compiles what a live node needs, which is less.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from usvlearn.errors import columns_of, complain, folded

WORDS = "float32 also compiles the estimators' kernels of that precision, readers those for binary logs and positions"


def warm(float32: bool = False, readers: bool = False, live: bool = False) -> Path:
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
    for dtype in map(np.dtype, (np.float64, np.float32) if float32 else (np.float64,)):
        compile_plans(dtype)
        compile_planar(dtype)
        if not live:
            compile_free_runs(dtype)
    compile_fit()
    turning.evaluate(turning.MEAN, [np.empty((0, ROW))])
    if readers:
        _compile_readers()
    return folder(Path(dispatch.__file__)).parent


def _compile_readers() -> None:
    """Read empty logs, and no positions."""
    from usvlearn.core.jit import announced
    from usvlearn.logs.channels import position_kernel
    from usvlearn.logs.formats.ardupilot import binary_kernel

    data, none = np.zeros(0, np.uint8), np.zeros(0)
    with announced(str(binary_kernel.__file__), "readers of binary logs"):
        places, layouts, *_ = binary_kernel.scan_dataflash(data, np.zeros(256, np.int64))
        binary_kernel.dataflash_stamps(data, places, layouts, *np.zeros((3, 1), np.int64))
        starts, lengths, *_ = binary_kernel.scan_tlog(data, np.full(binary_kernel.IDS, -1, np.int16))
        binary_kernel.gather(data, starts, lengths, 0, 1)
    position_kernel.velocities(none, none, none)


def main() -> int:
    """The command `usvlearn warm`; returns the exit code."""
    return _command(sys.argv[1:], "usvlearn warm", live=False)


def warm_live(arguments: Sequence[str]) -> int:
    """The command `usvlearn live warm`; returns the exit code."""
    return _command(list(arguments), "usvlearn live warm", live=True)


def _command(arguments: list[str], name: str, live: bool) -> int:
    usage = f"usage: {name} [float32] [readers]; {WORDS}"
    if arguments in (["-h"], ["--help"]):
        print(folded(usage, columns_of(sys.stdout)))
        return 0
    if not {*arguments} <= {"float32", "readers"}:
        found = " ".join(arguments)
        complain(f"error: found {found!r}, expected nothing, float32 or readers: {usage}")
        return 2
    kept = warm("float32" in arguments, "readers" in arguments, live)
    print(f"usvlearn: everything is compiled; it is kept in {kept}")
    if kept.is_relative_to(tempfile.gettempdir()):
        complain("warning: a restart of the computer empties this folder: set NUMBA_CACHE_DIR to another")
    return 0
