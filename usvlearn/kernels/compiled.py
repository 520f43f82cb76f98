"""How kernels are compiled by numba, and where the machine code is kept.

Numba looks at one file when it asks whether what it kept is still good, not at those whose functions that file calls.
So each state of all kernel sources has a folder of its own.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numba

SOURCES = sorted(Path(__file__).parent.glob("*.py"))


def folder() -> Path:
    """Where the machine code of these sources is kept: under `NUMBA_CACHE_DIR`, or the user's cache."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in SOURCES:
        digest.update(path.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    found = Path(base) / "usvlearn" / digest.hexdigest()[:16]
    try:
        found.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=found):
            return found
    except OSError:  # a home that cannot be written to
        return Path(tempfile.gettempdir()) / f"usvlearn-{os.getuid() if hasattr(os, 'getuid') else 0}" / found.name


FOLDER = folder()


def kernel(function: Callable | None = None, *, reorder: bool = False) -> Callable:
    """Compile a function when it is first called; without the GIL, and with division as NumPy's.

    Args:
        function: of numbers and arrays.
        reorder: whether sums may be taken several terms at a time: for long ones.
    """
    if function is None:
        return partial(kernel, reorder=reorder)
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(FOLDER)
    fastmath = {"contract", "reassoc"} if reorder else {"contract"}
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    finally:
        numba.config.CACHE_DIR = before


@contextmanager
def announced(name: str) -> Iterator[None]:
    """Say on stderr that something compiles, and how long it took, where that was never done on this machine."""
    mark = FOLDER / name
    if mark.exists():
        yield
        return
    print(f"usvlearn: compiling its kernels ({name}), once on this machine …", end="", file=sys.stderr, flush=True)
    began = time.perf_counter()
    yield
    print(f" {time.perf_counter() - began:.0f} s; kept in {FOLDER}", file=sys.stderr)
    try:
        mark.touch()
    except OSError:
        pass
