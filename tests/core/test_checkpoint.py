"""Checkpoints: complete, exact, atomic; damage and misfits are told apart and said."""

import os
import signal
import stat
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from safetensors.numpy import save as save_tensors

from usvlearn import AID, RLS, RNN, Ensemble, Online
from usvlearn.core import checkpoint as store
from usvlearn.core.samples import named_leaves
from usvlearn.errors import CheckpointError


def ensemble():
    return Ensemble({"aid": AID(28.0), "rls": RLS(), "rnn": RNN(6)})


def test_roundtrip_is_exact_and_complete(tmp_path):
    state = ensemble().init((2,))
    path = store.save(tmp_path / "deep" / "a.safetensors", state, estimator="Ensemble", boat="heron", time=12.5)
    restored, facts = store.restore(path, state, "Ensemble")
    expected = dict(named_leaves(state))
    assert dict(named_leaves(restored)).keys() == expected.keys()
    for name, leaf in named_leaves(restored):
        assert torch.equal(leaf, expected[name]) and leaf.dtype == expected[name].dtype, name
    assert facts == {"schema": 3, "estimator": "Ensemble", "boat": "heron", "time": 12.5}
    assert list(path.parent.iterdir()) == [path]  # no temporary file is left


def test_rnn_weights_keep_their_names(tmp_path):
    path = Online(RNN(6)).save(tmp_path / "rnn.safetensors")
    assert {"weights.a", "weights.w1", "weights.W2", "weights.b"} <= store.load(path)[0].keys()


def test_every_flipped_byte_is_noticed(tmp_path):
    path = store.save(tmp_path / "a.safetensors", {"theta": np.arange(3.0)}, boat="heron")
    content = path.read_bytes()
    for place in range(len(content)):
        damaged = bytearray(content)
        damaged[place] ^= 0x04
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"damaged|format"):
            store.load(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(CheckpointError, match="damaged"):
        store.load(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"\xff" * 64, b'{"json": 1}'])
def test_a_file_that_is_no_checkpoint(tmp_path, content):
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="not a usvlearn checkpoint"):
        store.load(path)
    with pytest.raises(CheckpointError, match="cannot be read"):
        store.load(tmp_path / "none.safetensors")


def test_another_estimator_or_size_is_refused(tmp_path):
    path = Online(RNN(6)).save(tmp_path / "a.safetensors")
    with pytest.raises(CheckpointError, match="'RNN', expected 'AID'"):
        Online(AID()).restore(path)
    with pytest.raises(CheckpointError, match=r"weights.a has the shape \(6,\), expected \(7,\)"):
        Online(RNN(7)).restore(path)
    with pytest.raises(CheckpointError, match=r"lacks .*theta"):
        store.restore(path, AID().init())


def test_a_run_with_one_boat_is_opened_and_several_boats_are_named(tmp_path):
    online = Online(AID(mass=28.0))
    online.save(tmp_path / "checkpoints" / "heron" / "000.safetensors")
    expected = dict(named_leaves(online.state))
    assert all((leaf == expected[name].numpy()).all() for name, leaf in Online.open(tmp_path).state.items())
    online.save(tmp_path / "checkpoints" / "otter" / "000.safetensors")
    with pytest.raises(CheckpointError, match=r"several boats: give .*heron or .*otter$"):
        Online.open(tmp_path)


def test_unreadable_newest_falls_back_with_a_warning(tmp_path):
    online = Online(AID())
    for k in range(3):
        online.state = online.state._replace(surge=torch.tensor(float(k), dtype=torch.float64))
        newest = online.save(tmp_path / f"{k:03d}.safetensors", step=k)
    newest.write_bytes(newest.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="002.*trying the one before"):
        assert online.restore(tmp_path)["step"] == 1
    assert online.state.surge == 1.0
    for path in store.checkpoints(tmp_path):
        path.write_bytes(b"")
    with pytest.warns(UserWarning), pytest.raises(CheckpointError, match="none of its 3"):
        online.restore(tmp_path)


WRITER = """
import sys, numpy as np
from usvlearn.core import checkpoint
k = 0
while True:
    checkpoint.save(sys.argv[1] + "/a.safetensors", {"theta": np.full(20_000, float(k))}, k=k)
    k += 1
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_kill_at_any_moment_leaves_a_whole_file(tmp_path):
    """One file is replaced without end, and the writer is killed at some moment."""
    path = tmp_path / "a.safetensors"
    for trial in range(6):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)])
        try:
            started = time.monotonic()
            while not path.exists() and time.monotonic() - started < 60:
                time.sleep(0.005)
            time.sleep(0.05 + 0.013 * trial)
        finally:
            os.kill(writer.pid, signal.SIGKILL)
            writer.wait()
        leaves, facts = store.load(path)
        assert (leaves["theta"] == facts["k"]).all()
    store.save(path, {"theta": np.zeros(1)})
    assert list(tmp_path.iterdir()) == [path]  # what the killed ones left is gone


@pytest.mark.thorough
def test_several_processes_save_to_one_path(tmp_path):
    """None of them fails, and the file is the last one's, whole."""
    code = WRITER.replace("while True", "while k < 40")
    writers = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(4)]
    assert [writer.wait(120) for writer in writers] == [0] * 4
    assert (store.load(tmp_path / "a.safetensors")[0]["theta"] == 39).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_temporary_files_of_writers_that_were_killed_are_removed(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    names = [f".b.safetensors.{store.HOST}-{process}-7.tmp" for process in (ended.pid, os.getpid(), os.getppid())]
    others = [".b.safetensors.00000000-1-7.tmp", ".notes.tmp", "b-1-7.tmp"]  # of another machine, of nobody
    for name in (*names, *others):
        (tmp_path / name).write_bytes(b"half")
    path = store.save(tmp_path / "a.safetensors", {"theta": np.ones(1)})
    assert {path.name for path in tmp_path.iterdir()} == {"a.safetensors", names[2], *others}
    assert store.checkpoints(tmp_path) == [path]


class Recorded:
    """`os`, which notes what is flushed to the disk and what is renamed."""

    def __init__(self):
        self.done = []

    def __getattr__(self, name):
        return getattr(os, name)

    def fsync(self, file):
        info = os.fstat(file)
        self.done.append(("folder" if stat.S_ISDIR(info.st_mode) else f"{info.st_size} bytes", info.st_ino))
        os.fsync(file)

    def replace(self, old, new):
        self.done.append(("renamed", os.stat(old).st_ino))
        os.replace(old, new)


def test_file_and_folder_are_flushed_in_that_order(tmp_path, monkeypatch):
    """A power cut leaves the old file or the new one: all of it is on the disk before it has its name."""
    monkeypatch.setattr(store, "os", recorded := Recorded())
    path = tmp_path / "a.json"
    store.write_atomically(path, b"12345")
    file, folder = path.stat().st_ino, tmp_path.stat().st_ino
    assert recorded.done == [("5 bytes", file), ("renamed", file), ("folder", folder)]


def test_a_writer_leaves_what_another_thread_is_writing(tmp_path, monkeypatch):
    def fsync(file, flush=os.fsync):
        monkeypatch.setattr(os, "fsync", flush)
        store.write_atomically(tmp_path / "b.json", b"b")
        flush(file)

    monkeypatch.setattr(os, "fsync", fsync)
    store.write_atomically(tmp_path / "a.json", b"a")
    assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == [b"a", b"b"]


FOREIGN = {
    "list": "[]", "number": "1", "null": "null", "text": '"a"', "deep": '{"schema": 2, "a": ' + "[" * 100_000,
    "closed": '{"schema": 2, "a": ' + "[" * 100_000 + "]" * 100_000 + "}", "digits": '{"schema": ' + "9" * 5000 + "}",
    "schemas": '{"schema": [2]}', "cut": '{"schema": 2', "half": '{"schema": 2, "a": "\\ud800"}',
}  # fmt: skip


@pytest.mark.parametrize("case", FOREIGN)
def test_foreign_metadata_are_passed_over(tmp_path, case):
    store.save(tmp_path / "1.safetensors", {"theta": np.ones(1)}, estimator="AID")
    bad = tmp_path / "2.safetensors"
    bad.write_bytes(save_tensors({"theta": np.ones(1)}, {store.KEY: FOREIGN[case]}))
    with pytest.raises(CheckpointError, match=r"2.safetensors: (is not a usvlearn|has the format|is damaged)"):
        store.load(bad)
    with pytest.warns(UserWarning, match="trying the one before"):
        assert store.newest(tmp_path, lambda path: store.restore(path, {"theta": np.zeros(1)}))[1]["estimator"] == "AID"
    with pytest.warns(UserWarning, match="trying the one before"):
        assert store.newest(tmp_path, store.load)[1]["estimator"] == "AID"


@pytest.mark.parametrize("dtype", [np.int64, np.complex64, bool, np.uint8])
def test_other_numbers_are_refused(tmp_path, dtype):
    """Of another precision they may be, not of another sort."""
    path = store.save(tmp_path / "a.safetensors", {"theta": np.ones(2, dtype)})
    for template in ({"theta": np.ones(2)}, {"theta": torch.ones(2)}):
        with pytest.raises(CheckpointError, match=f"theta is {np.dtype(dtype)}, expected .*float"):
            store.restore(path, template)
    single = store.save(tmp_path / "a.safetensors", {"theta": np.ones(2, np.float32)})
    assert store.restore(single, {"theta": np.ones(2)})[0]["theta"].dtype == np.float64


def test_a_header_is_not_quoted_whole(tmp_path):
    header = b'{"theta":{"dtype":"%s","shape":[1],"data_offsets":[0,8]}}' % (b"x" * 5000)
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(CheckpointError, match="x" * 100) as caught:
        store.load(path)
    assert len(str(caught.value)) < 800


def test_a_foreign_estimator_is_told_in_one_sentence(tmp_path):
    path = store.save(tmp_path / "a.safetensors", {"theta": np.ones(2)}, estimator=["x" * 100] * 1000)
    with pytest.raises(CheckpointError, match="expected 'AID': give a checkpoint of AID") as caught:
        store.restore(path, {"theta": np.ones(2)}, "AID")
    assert len(str(caught.value)) < 500
