"""Where machine code is kept, and what is done where it is damaged."""

import errno
import os
import shutil
import subprocess
import threading
from pathlib import Path
from typing import IO

import numba
import numpy as np
import pytest
from numba.core import caching

from tests.support import ROOT
from tests.support.commands import python
from usvlearn.core import jit as compiled
from usvlearn.core.lock import Lock
from usvlearn.engine import dispatch

PREPARE = """
import numpy as np
from usvlearn.core import prepared_samples as samples
from usvlearn.core.jit import announce
with announce(samples.__file__, "trial"):
    ones = np.ones((2, 1))
    rows = np.empty((1, 2, samples.ROW))
    samples.prepare_all(*[ones] * 6, ones > 0, ones > 0, True, 100.0, rows)
print(rows[0, 0, -1])
"""


@pytest.fixture(scope="module")
def once(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    """A folder of machine code, which nobody changes, and the program that filled it."""
    cache = tmp_path_factory.mktemp("kept")
    return cache, python(PREPARE, NUMBA_CACHE_DIR=str(cache))


@pytest.mark.thorough
def test_machine_code_is_kept_and_announced_once(once):
    cache, first = once
    (folder,) = (cache / "usvlearn").glob("kernels-*")
    assert first.stdout == "3.0\n" and f"kept in {folder}" in first.stderr
    assert first.stderr.startswith("usvlearn: compiling the trial, only once …")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")}
    assert before
    again = python(PREPARE, NUMBA_CACHE_DIR=str(cache))
    assert again.stdout == "3.0\n" and again.stderr == ""
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")} == before


@pytest.mark.thorough
def test_another_checkout_with_the_same_sources_uses_the_machine_code(once, tmp_path):
    cache, _ = once
    stamps = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb*")}
    shutil.copytree(ROOT / "usvlearn", tmp_path / "copy" / "usvlearn", ignore=shutil.ignore_patterns("__pycache__"))
    for path in (tmp_path / "copy").rglob("*.py"):
        os.utime(path, (1, 1))
    script = f"import sys\nsys.path.insert(0, {str(tmp_path / 'copy')!r})\n{PREPARE}print(samples.__file__)\n"
    done = python(script + "print(*samples.prepare_all.stats.cache_hits.values())", NUMBA_CACHE_DIR=str(cache))
    assert (
        done.stdout.split() == ["3.0", str(tmp_path / "copy/usvlearn/core/prepared_samples.py"), "1"]
        and done.stderr == ""
    )
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb*")} == stamps


def twice(x):
    return 2 * x


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_machine_code_is_said_and_compiled_anew(tmp_path, monkeypatch, capsys, suffix):
    """Truncated, empty, garbage, one bit: whatever a power cut leaves."""
    monkeypatch.setattr(compiled, "folder", lambda source: tmp_path)

    def restarted():
        compiled._say.cache_clear()
        function = compiled.jit(twice, entry=True)
        assert function(1.5) == 3.0
        return function.stats.cache_hits, capsys.readouterr().err

    assert not any(restarted()[0].values())
    (path,) = tmp_path.rglob(f"*{suffix}")
    good = path.read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 4
    for bad in (good[:-1], good[: len(good) // 2], b"", np.random.default_rng(0).bytes(len(good)), bytes(flipped)):
        path.write_bytes(bad)
        hits, said = restarted()
        assert not any(hits.values()) and said.count("is damaged; it is compiled anew") == 1
        hits, said = restarted()
        assert sum(hits.values()) == 1 and said == ""


@pytest.mark.thorough
def test_a_home_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "other").mkdir()
    done = python(PREPARE, NUMBA_CACHE_DIR=str(tmp_path / "file"), TMPDIR=str(tmp_path / "other"))
    assert done.stdout == "3.0\n" and list((tmp_path / "other").glob("usvlearn-*/kernels-*/**/*.nb*"))


READ_ONLY = """
import errno, tempfile
real = tempfile.TemporaryFile
def refuse(*arguments, dir=None, **options):
    if str(dir).startswith({kept!r}):
        raise OSError(errno.EROFS, "read-only")
    return real(*arguments, dir=dir, **options)
tempfile.TemporaryFile = refuse
"""


@pytest.mark.thorough
def test_machine_code_that_can_only_be_read_is_used(once, tmp_path):
    """As on a disk that is mounted read-only, or where another user has made it."""
    cache, other = once[0], tmp_path / "other"
    other.mkdir()
    before = sorted(cache.rglob("*"))
    for _ in range(2):  # the second time it is copied already
        done = python(
            READ_ONLY.format(kept=str(cache)) + PREPARE + "print(*samples.prepare_all.stats.cache_hits.values())",
            NUMBA_CACHE_DIR=str(cache), TMPDIR=str(other),
        )  # fmt: skip
        assert done.stdout == "3.0\n1\n" and done.stderr == ""
    assert sorted(cache.rglob("*")) == before and len(list(other.glob("usvlearn-*/*"))) == 1


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of the package's sources, and the folder that the kernels of runs have there."""
    root = tmp_path / "copy" / "usvlearn"
    shutil.copytree(ROOT / "usvlearn", root, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiled, "HERE", root)

    def forget():
        compiled.folder.cache_clear()
        compiled._imported.cache_clear()

    def folder(source: str = "engine/dispatch.py"):
        forget()
        return compiled.folder(root / source)

    yield root, folder
    forget()


CHANGES = (  # a file, what is in it, and what it becomes: the same with a line more, or something else
    ("core/samples.py", "PLAUSIBLE = 100.0", "PLAUSIBLE = 101.0"),  # a constant in a file without @jit
    ("core/family.py", "MOST = 1e-30, 1e30", "MOST = 1e-30, 1e31"),
    ("estimators/aid/kernel.py", "def adapt(", "def adapt("),
    ("estimators/aid/state.py", "    GAIN = POSITIVE\n    LEAK = POSITIVE", "    LEAK = POSITIVE\n    GAIN = POSITIVE"),
    ("estimators/baselines/persistence/kernel.py", "def coast", "def coast"),
    ("estimators/__init__.py", '"least_squares",\n    "aid",', '"aid",\n    "least_squares",'),
    ("engine/dispatch_tables.py", "def chain(", "def chain("),
    ("core/jit.py", '"nogil": True', '"nogil": False'),
)


@pytest.mark.parametrize(("source", "old", "new"), CHANGES)
def test_each_state_of_the_sources_has_a_folder_of_its_own(copied, source, old, new):
    root, folder = copied
    before, path = folder(), root / source
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new) + "\n")
    after = folder()
    path.write_text(text)
    assert after != before == folder()


@pytest.mark.parametrize("option", compiled.OPTIONS)
def test_each_option_of_numba_that_changes_the_code_has_a_folder_of_its_own(option, copied, monkeypatch):
    _, folder = copied
    before = folder()
    monkeypatch.setattr(compiled.NUMBA, option, int(not getattr(compiled.NUMBA, option)))
    assert folder() != before


@pytest.mark.thorough
def test_indices_of_parts_are_checked_where_numba_is_asked_to(tmp_path):
    """Also where the unchecked code is kept in the same cache."""
    (tmp_path / "trial.py").write_text(BEYOND)
    run = f"import sys; sys.path.append({str(tmp_path)!r}); import trial"
    for value, printed in (("0", "read\n"), ("1", "index is out of bounds\n"), ("0", "read\n")):
        assert python(run, NUMBA_CACHE_DIR=str(tmp_path), NUMBA_BOUNDSCHECK=value).stdout == printed


BEYOND = """
import numpy as np
from usvlearn.core.jit import jit
@jit
def part(x, k):
    return x[k]
@jit(entry=True)
def entry(x, k):
    return part(x, k)
try:
    entry(np.ones(9)[:3], 4)  # beyond the array, within its memory
    print("read")
except IndexError as error:
    print(error)
"""


def test_a_file_beside_the_package_is_known_by_its_place(tmp_path, monkeypatch):
    """What it imports from others is not in the hash."""
    folders = []
    for name in ("one", "other"):
        monkeypatch.setattr(compiled, "HERE", tmp_path / name / "usvlearn")
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text("from theirs import K\n")
        folders.append(compiled.folder(tmp_path / name / "mine.py"))
    assert folders[0] != folders[1]


def test_files_that_are_not_in_machine_code_change_no_folder(copied):
    root, folder = copied
    before = folder()
    for source in ("estimators/aid/layer.py", "engine/online.py", "simulate/missions_kernel.py", "README.md"):
        path = root / source
        path.write_text(f"{path.read_text() if path.exists() else ''}\n# changed\n")
    assert folder() == before


@pytest.mark.parametrize("form", [
    "from usvlearn.estimators.aid.trial import A", "from usvlearn.estimators.aid import trial",
    "import usvlearn.estimators.aid.trial as t", "def f():\n    from usvlearn.estimators.aid.trial import (\n A)",
])  # fmt: skip
def test_a_file_from_which_a_kernel_takes_a_constant_is_in_the_folder(form, copied):
    root, folder = copied
    kernel, folders = root / "estimators" / "aid" / "kernel.py", []
    kernel.write_text(f"{kernel.read_text()}\n{form}\n")
    for value in (1, 2):
        kernel.with_name("trial.py").write_text(f"A = {value}\n")
        folders.append(folder())
    assert folders[0] != folders[1]


def test_the_kernels_know_all_families_and_no_layer():
    files = {path.relative_to(compiled.HERE).as_posix() for path in compiled.sources(Path(dispatch.__file__))}
    kernels = {path.relative_to(compiled.HERE).as_posix() for path in compiled.HERE.glob("estimators/**/*kernel.py")}
    assert kernels | {f"core/{name}.py" for name in ("samples", "family", "prepared_samples", "arrays", "jit")} <= files
    assert not any("layer" in name for name in files)


def test_machine_code_that_a_full_disk_cannot_keep_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compiled, "folder", lambda source: tmp_path)

    def full(path: str, mode: str) -> IO:  # it can still be read
        if "w" in mode:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return open(path, mode)

    with monkeypatch.context() as patch:
        patch.setattr(caching, "open", full, raising=False)
        assert compiled.jit(twice, entry=True)(1.5) == 3.0
    assert capsys.readouterr().err.count("cannot be kept in") == 1
    assert compiled.jit(twice, entry=True)(1.5) == 3.0
    function = compiled.jit(twice, entry=True)
    assert function(1.5) == 3.0 and sum(function.stats.cache_hits.values()) == 1


TRIAL = """
from usvlearn.core import jit
@jit.jit
def half(x):
    return x / 2
@jit.jit(entry=True)
def add(x, y):
    return half(x) + half(y)
print(jit.Part is None, add(3.0, 4.0), half(5.0), half(7), len(add.overloads), half.py_func(3))
"""


@pytest.mark.thorough
def test_parts_are_compiled_within_their_callers_or_alone_where_numba_lacks_what_they_need(tmp_path):
    """Either way Python can call a part, too."""
    (tmp_path / "trial.py").write_text(TRIAL)
    run = f"import sys; sys.path.append({str(tmp_path)!r}); import trial"
    parted = python(run, NUMBA_CACHE_DIR=str(tmp_path / "parts")).stdout
    assert parted == f"{numba.version_info.short > (0, 68)} 3.5 2.5 3.5 1 1.5\n"
    plain = python(
        f"import sys; sys.modules['usvlearn.core.linked_functions'] = None; {run}",
        NUMBA_CACHE_DIR=str(tmp_path / "plain"),
    )
    assert plain.stdout == "True 3.5 2.5 3.5 1 1.5\n"


@pytest.mark.thorough
def test_a_numba_that_lacks_a_name_has_no_parts():
    code = "from numba.core.codegen import JITCodeLibrary, CPUCodeLibrary\ndel CPUCodeLibrary._optimize_final_module\n"
    assert python(f"{code}from usvlearn.core import jit\nprint(jit.Part)").stdout == "None\n"


def test_who_waits_goes_on_once_the_machine_code_is_there(tmp_path):
    """Though the process that made it holds the lock, because it compiles something else."""
    mark = tmp_path / "kernels of runs"
    with Lock(tmp_path, "x"):
        threading.Timer(0.2, mark.touch).start()
        with compiled._alone_in(mark) as lock:
            assert mark.exists() and lock is None


def test_one_process_at_a_time_compiles(tmp_path):
    lock = Lock(tmp_path, "x")
    threading.Timer(0.2, lock.release).start()
    with compiled._alone_in(tmp_path / "kernels of runs") as alone:
        assert isinstance(alone, Lock)
    (tmp_path / ".lock").mkdir()
    with compiled._alone_in(tmp_path / "kernels of runs") as none:
        assert none is None
