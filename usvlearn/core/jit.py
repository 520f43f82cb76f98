"""Compiles functions by numba, and keeps the machine code in a folder.

Numba checks one source file to decide whether cached machine code is current. But machine code also contains the
functions that this file calls and the constants that it imports. So the cache is a folder whose name is a hash of the
file and of all files of this package that it imports, directly or not. Environments and checkouts with the same files
share it. Each cached file ends with its sha256, because a power cut or a bad disk can damage it, and damaged machine
code must not run.
"""

from __future__ import annotations

import ast
import gc
import hashlib
import io
import os
import shutil
import stat
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, overload

import numba
from llvmlite.binding import get_host_cpu_name
from numba.core import config, types
from numba.core.caching import IndexDataCacheFile
from numba.core.typing import arraydecl

from usvlearn.core.activity import SHOW
from usvlearn.core.lock import NAME as LOCK
from usvlearn.core.lock import Lock
from usvlearn.errors import UsvlearnError

try:
    from usvlearn.core.linked_functions import Part
except (ImportError, AttributeError):  # a version of numba with other internals
    Part = None  # type: ignore[assignment, misc]  # no type says "this class, or None"

P = ParamSpec("P")
R = TypeVar("R", covariant=True)

NUMBA: Any = config  # numba's options, which it makes as it is imported, so that no checker sees their names
HERE = Path(__file__).parents[1]  # the package
DIGEST = hashlib.sha256().digest_size
PERIOD = 0.02  # s between two looks at what another process compiles
# options of numba that change the machine code; those of the processor are in numba's own index
OPTIONS = "BOUNDSCHECK", "OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "DEBUGINFO_DEFAULT", "USING_SVML"

if numba.version_info.short < (0, 68):  # these take a member of an IntEnum as a number, but not as an index
    _index_type = arraydecl.get_array_index_type

    def _as_integer(index: Any) -> Any:
        if isinstance(index, types.BaseTuple):
            parts: Any = index  # its type has no iterator for a checker
            return types.BaseTuple.from_types([_as_integer(each) for each in parts])
        return index.dtype if isinstance(index, types.IntEnumMember) else index

    arraydecl.get_array_index_type = lambda array, index: _index_type(array, _as_integer(index))


@cache
def folder(source: Path) -> Path:
    """Where the machine code of a source file's functions is kept: under `NUMBA_CACHE_DIR`, or the user's cache."""
    own = source.relative_to(HERE) if source.is_relative_to(HERE) else source  # what others import is not in the hash
    machine = numba.__version__, *(getattr(NUMBA, each, None) for each in OPTIONS), get_host_cpu_name()
    digest = hashlib.sha256("\n".join(map(str, (*machine, sys.implementation.cache_tag, own))).encode())
    for path in sorted(sources(source)):
        digest.update(path.read_bytes())
    name = f"kernels-{digest.hexdigest()[:12]}"
    try:
        base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no home
        return _temporary() / name
    place = Path(base) / "usvlearn" / name
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return place
    except OSError:
        return _copied(place, _temporary() / name)


def _copied(source: Path, target: Path) -> Path:
    """A folder of this user with the machine code of one that cannot be written to; numba would not use that one."""
    with suppress(OSError):
        if source.is_dir() and not target.exists():
            part = tempfile.mkdtemp(dir=target.parent)
            shutil.copytree(source, part, dirs_exist_ok=True)
            os.rename(part, target)
    return target


def sources(path: Path) -> set[Path]:
    """A source file, and those of this package that it imports, directly or not: all that is in its machine code."""
    files: set[Path] = set()
    ahead = [path]
    while ahead:
        if (path := ahead.pop()) not in files:
            files.add(path)
            ahead += _imported(path)
    return files


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    """The files of this package that a source file imports."""
    imports: list[Path] = []
    for names in _import_names(path.read_bytes()):
        places = [HERE.parent.joinpath(*name.split(".")) for name in names if name.split(".")[0] == HERE.name]
        files = (file for place in places for file in (place.with_suffix(".py"), place / "__init__.py"))
        imports += [file for file in files if file.is_file()][:1]
        if f"{HERE.name}.estimators.COMPILED" in names:  # the kernels of this list are imported by name
            imports += (HERE / "estimators").rglob("kernel.py")
    return tuple(imports)


@cache
def _import_names(content: bytes) -> tuple[tuple[str, ...], ...]:
    """For each import of a source, the names that may be a module, the longest first. Each content is parsed once."""
    names: list[tuple[str, ...]] = []
    for node in ast.walk(ast.parse(content)):
        if isinstance(node, ast.Import):
            names += [(each.name,) for each in node.names]
        elif isinstance(node, ast.ImportFrom):  # `from usvlearn.engine import dispatch` names a module
            names += [(f"{node.module}.{each.name}", str(node.module)) for each in node.names]
    return tuple(names)


@cache
def _temporary() -> Path:
    """A temporary folder that only this user can write to, because the code in it is run."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    temporary = Path(tempfile.gettempdir()) / f"usvlearn-{user}"
    try:
        temporary.mkdir(mode=0o700, exist_ok=True)
        state = temporary.lstat()
        if stat.S_ISDIR(state.st_mode) and (not user or state.st_uid == user) and not state.st_mode & 0o022:
            return temporary
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="usvlearn-"))


class Compiled(Protocol[P, R]):
    """A compiled function, which Python calls as the function that it was made from."""

    py_func: Callable[..., Any]
    stats: Any  # numba's counts of what its cache had, and had not

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """The function's value."""
        ...

    def disable_compile(self, val: bool = True) -> None:
        """Allow no other types of arguments than those that it was compiled for."""


@overload
def jit(
    function: Callable[P, R], *, entry: bool = ..., inline: bool = ..., reorder: bool = ..., memory: bool = ...
) -> Compiled[P, R]: ...
@overload
def jit(
    *, entry: bool = ..., inline: bool = ..., reorder: bool = ..., memory: bool = ...
) -> Callable[[Callable[P, R]], Compiled[P, R]]: ...


def jit(
    function: Callable[..., Any] | None = None,
    *,
    entry: bool = False,
    inline: bool = False,
    reorder: bool = False,
    memory: bool = False,
) -> Any:
    """Compile a function of numbers and arrays when it is first called; without the GIL, with division as NumPy's.

    Args:
        entry: whether Python calls it. What only compiled functions call has no machine code of its own (`Part`).
        inline: whether it is always inlined: passing arrays costs some ns in each call.
        reorder: whether the compiler may reorder sums, which vectorises long ones.
        memory: whether it may make arrays; if not, numba counts no references, which costs more than most kernels.
    """
    if function is None:
        return partial(jit, entry=entry, inline=inline, reorder=reorder, memory=memory)
    fastmath = {"contract", "reassoc"} if reorder else {"contract"}
    options = {"nogil": True, "error_model": "numpy", "fastmath": not memory and fastmath, "_nrt": memory}
    options |= {"no_cfunc_wrapper": True, "forceinline": inline}
    alone = partial(_alone, options=options)
    return alone(function) if entry or Part is None or NUMBA.DISABLE_JIT else Part(function, options, alone)


def _alone(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    """A function that Python can call, with its machine code cached."""
    place = folder(Path(function.__code__.co_filename))
    before, NUMBA.CACHE_DIR = NUMBA.CACHE_DIR, str(place)
    try:
        compiled = numba.njit(cache=True, **options)(function)
    finally:
        NUMBA.CACHE_DIR = before
    if (cache := getattr(compiled, "_cache", None)) is not None:  # None under NUMBA_DISABLE_JIT
        cache._cache_file = CheckedFiles(cache._cache_file, place)
    return compiled


class CheckedFiles(IndexDataCacheFile):
    """Numba's cache files of one function, each with its sha256 at the end; a damaged one is removed and recompiled.

    Numba's own place depends on where the source is installed, and when; the folder here on what is in the source.
    """

    def __init__(self, plain: IndexDataCacheFile, place: Path):
        vars(self).update(vars(plain))
        self._cache_path, self._index_path = str(place), str(place / self._index_name)
        self._source_stamp: None = None

    def load(self, key: object) -> object:
        """The cached code of a key; None where there is none, or it is damaged."""
        index = Path(self._index_path)
        if not index.exists():
            return None
        if whole(index):
            if (name := self._load_index().get(key)) is None:
                return None
            if whole(Path(self._data_path(name))):
                return self._load_data(name)
        index.unlink(missing_ok=True)  # without it numba asks for no other file
        _say(f"compiled code in {index.parent} is damaged; it is compiled anew, in a minute or so")
        return None

    def save(self, key: object, data: object) -> None:
        """Cache compiled code; where the disk is full, say so, and continue without."""
        try:
            super().save(key, data)
        except OSError as error:
            where = f"{self._cache_path} ({error.strerror})"
            _say(f"compiled code cannot be kept in {where}; the next start compiles it anew")

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(filepath) as file:
            content = io.BytesIO()
            yield content
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())


def whole(path: Path) -> bool:
    """Whether a file ends with the sha256 of all before."""
    try:
        content = path.read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content[:-DIGEST]).digest() == content[-DIGEST:]


@cache
def _say(text: str) -> None:
    """Print this once."""
    print(f"usvlearn: {text}", file=sys.stderr)


def mark_of(source: str, what: str) -> Path:
    """The file that tells that this was compiled, and that its machine code is kept."""
    return folder(Path(source)) / what.replace(" ", "-")


@contextmanager
def announce(source: str, what: str) -> Iterator[None]:
    """Report on stderr the first compilation of a source file's functions on this machine, and its duration.

    One process at a time compiles; another waits, and then finds the machine code.
    """
    mark = mark_of(source, what)
    if NUMBA.DISABLE_JIT or mark.exists():
        yield
        return
    with count_seconds(f"compiling the {what}, only once …", f"kept in {mark.parent}"), _alone_in(mark):
        with rare_collections():
            yield
        with suppress(OSError):
            mark.touch()


@contextmanager
def count_seconds(text: str, end: str) -> Iterator[None]:
    """Tell what is done, and count its seconds, in the line in which a command shows its progress; nothing is left of
    it there. Else print it on stderr, and behind it how long it took; a terminal counts seconds in that line.
    """
    show, began, ended, terminal = SHOW.get(), time.perf_counter(), threading.Event(), sys.stderr.isatty()
    whole = "" if show else f"usvlearn: {text}"

    def count() -> None:
        while not ended.wait(1.0):
            taken = f"{time.perf_counter() - began:.0f} s"
            show(f"{taken} {text}") if show else print(f"\r{whole} {taken}", end="", file=sys.stderr, flush=True)

    counter = threading.Thread(target=count, daemon=True)
    show(text) if show else print(whole, end="", file=sys.stderr, flush=True)
    if show or terminal:
        counter.start()
    try:
        yield
    except BaseException:
        ended.set()
        if not show:
            print(file=sys.stderr)  # end the line before the error is printed
        raise
    ended.set()
    if counter.is_alive():
        counter.join()
    if not show:
        taken = f" {time.perf_counter() - began:.0f} s"
        print(f"\r{whole}{taken}\033[K\n  {end}" if terminal else f"{taken}; {end}", file=sys.stderr)


def _alone_in(mark: Path) -> AbstractContextManager[object]:
    """The lock of a mark's folder; nothing once another process has left the mark, or where locking fails."""
    lock = mark.parent / LOCK
    with suppress(OSError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file system without locks
        while not mark.exists() and not lock.is_symlink() and (lock.is_file() or not lock.exists()):
            with suppress(UsvlearnError):  # another process compiles
                return Lock(mark.parent, "NUMBA_CACHE_DIR")
            time.sleep(PERIOD)
    return nullcontext()


@contextmanager
def rare_collections() -> Iterator[None]:
    """Let Python look for garbage rarely: the compiler makes many objects that stay, and looking took a fifth of it."""
    before = gc.get_threshold()
    if before[0]:  # 0: the program has switched it off
        gc.set_threshold(max(before[0], 100_000), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
