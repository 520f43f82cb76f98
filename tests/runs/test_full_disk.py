"""A disk that is full, or a folder that cannot be one: one sentence, code 2, and what was saved before is whole."""

import errno
import json
import os
import subprocess
import sys
import warnings

import pytest
from tensorboard.compat.tensorflow_stub.io.gfile import LocalFileSystem

from tests.support import ROOT, few
from tests.support.commands import ENVIRONMENT, QUICK, called, command, complaints
from tests.support.runs import assert_same, session
from usvlearn.cli import train
from usvlearn.core import checkpoint
from usvlearn.display.tensorboard import TensorBoardWriter
from usvlearn.errors import bad_input


class FullDisk:
    """Files of `checkpoint` whose k-th write or flush to the disk finds no room; half of a write comes through."""

    def __init__(self, monkeypatch, last: int):
        self.calls, self.last = 0, last
        monkeypatch.setattr(checkpoint, "open", self.open, raising=False)
        fsync = os.fsync
        monkeypatch.setattr(checkpoint.os, "fsync", lambda file: (self.count(), fsync(file)))

    def count(self) -> None:
        self.calls += 1
        if self.calls > self.last:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def open(self, *arguments):
        file, disk = open(*arguments), self

        class File:
            def __enter__(self):
                return self

            def __exit__(self, *_):
                file.close()

            def write(self, content):
                file.write(content[: len(content) // 2])
                disk.count()
                file.write(content[len(content) // 2 :])

            def __getattr__(self, name):
                return getattr(file, name)

        return File()


@pytest.mark.thorough
def test_whatever_write_fails_what_was_saved_before_is_whole(tmp_path, fleet):
    whole = session(tmp_path / "whole", fleet)
    for last in range(200):
        path = tmp_path / f"run{last}"
        with pytest.MonkeyPatch.context() as patch:
            disk = FullDisk(patch, last)
            try:
                session(path, fleet)
            except OSError as error:
                sentence = bad_input(error)
                assert "No space left on device: make room" in sentence and str(path) in sentence
            if disk.calls <= last:
                break
        for file in path.rglob("*.safetensors"):
            checkpoint.load(file)
        assert not list(path.rglob(".*.tmp"))
        if (path / "runs.json").exists():
            json.loads((path / "runs.json").read_text())
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a place whose checkpoints are not all there is passed over
                assert_same(session(path, fleet, "latest"), whole)
    assert last > 20


def test_tensorboard_raises_that_there_is_no_room_and_prints_nothing_else(tmp_path, monkeypatch, capsys):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left") as caught, TensorBoardWriter(tmp_path, ["a", "b"]) as board:
        board.scalars({"b": 1.0}, 0, "a")
        board.flush()
        monkeypatch.setattr(LocalFileSystem, "append", full)
        board.scalars({"b": 1.0}, 1, "a")
    assert bad_input(caught.value) is not None
    monkeypatch.undo()
    with TensorBoardWriter(tmp_path) as board:  # room again
        board.scalars({"b": 2.0}, 2, "a")
    assert len(list((tmp_path / "a").iterdir())) == 2 and capsys.readouterr() == ("", "")


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit there")
@pytest.mark.parametrize("limit", few([20_000, 60_000], [60_000]))
def test_a_run_with_too_little_room_ends_in_one_sentence(limit, tmp_path):
    code = (
        "import resource, runpy, sys\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
        f"sys.argv = {command(*QUICK, 'hydra.run.dir=run')[1:]}\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    environment = {**ENVIRONMENT, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    error = complaints(done.stderr)
    assert error.startswith("error: ") and len(error.splitlines()) == 1
    assert "File too large: make room there" in error
    for path in tmp_path.rglob("*.safetensors"):
        checkpoint.load(path)


@pytest.mark.thorough
@pytest.mark.parametrize("folder", ["file", "file/run", "/proc/run", "/dev/null"])
@pytest.mark.parametrize("key", ["run", "sweep"])
def test_a_folder_that_cannot_be_one_is_told(folder, key, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    arguments = [*(["-m", "align.dt=0.4,0.5"] if key == "sweep" else []), f"hydra.{key}.dir={folder}"]
    code, error = called(train.main, arguments, monkeypatch, capsys)
    assert code == 2 and len(error.splitlines()) == 1 and folder in error, error


def test_a_folder_that_is_read_only_is_told(tmp_path, monkeypatch, capsys):
    def refused(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / "run"))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pathlib.Path.mkdir", refused)
    code, error = called(train.main, ["hydra.run.dir=run"], monkeypatch, capsys)
    assert code == 2 and "run: Permission denied: correct that, or name another" in error
