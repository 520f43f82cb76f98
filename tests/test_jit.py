"""Where machine code is kept, and what is done where it is damaged."""

import errno
import os

import numpy as np
import pytest
from numba.core import caching

from tests.support.commands import python
from usvlearn import jit as compiled

PREPARE = """
import numpy as np
from usvlearn import rows as samples
from usvlearn.jit import announced
with announced(samples.__file__, "trial"):
    ones = np.ones((2, 1))
    rows = np.empty((1, 2, samples.ROW))
    samples.prepare_all(*[ones] * 6, ones > 0, ones > 0, True, 100.0, rows)
print(rows[0, 0, -1])
"""


def test_machine_code_is_kept_and_announced_once(tmp_path):
    first = python(PREPARE, NUMBA_CACHE_DIR=str(tmp_path))
    (folder,) = (tmp_path / "usvlearn").glob("kernels-*")
    assert first.stdout == "3.0\n" and f"kept in {folder}" in first.stderr
    assert first.stderr.startswith("usvlearn: compiling the trial, once on this machine …")
    kept = {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")}
    assert kept
    again = python(PREPARE, NUMBA_CACHE_DIR=str(tmp_path))
    assert again.stdout == "3.0\n" and again.stderr == ""
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb*")} == kept


def twice(x):
    return 2 * x


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_machine_code_is_said_and_compiled_anew(tmp_path, monkeypatch, capsys, suffix):
    """Truncated, empty, garbage, one bit: whatever a power cut leaves."""
    monkeypatch.setattr(compiled, "folder", lambda package: tmp_path)

    def restarted():
        compiled._say_damaged.cache_clear()
        function = compiled.jit(twice)
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


def test_a_home_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "other").mkdir()
    done = python(PREPARE, NUMBA_CACHE_DIR=str(tmp_path / "file"), TMPDIR=str(tmp_path / "other"))
    assert done.stdout == "3.0\n" and list((tmp_path / "other").glob("usvlearn-*/kernels-*/**/*.nb*"))


def test_another_source_has_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    source = tmp_path / "part" / "a.py"
    source.parent.mkdir()
    found = []
    for body in ("\n@jit\ndef f(): return 1\n", "\n@jit\ndef f(): return 2\n", "\n@jit\ndef f(): return 1\n"):
        source.write_text(body)
        compiled.folder.cache_clear()
        found.append(compiled.folder(source.parent))
    compiled.folder.cache_clear()
    assert found[0] == found[2] != found[1]


def test_machine_code_that_a_full_disk_cannot_keep_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compiled, "folder", lambda package: tmp_path)

    def full(path: str, mode: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(caching, "open", full, raising=False)
        assert compiled.jit(twice)(1.5) == 3.0
    assert capsys.readouterr().err.count("cannot be kept in") == 1
    assert compiled.jit(twice)(1.5) == 3.0
    function = compiled.jit(twice)
    assert function(1.5) == 3.0 and sum(function.stats.cache_hits.values()) == 1
