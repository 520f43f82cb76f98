"""Checkpoints that were damaged, and such that were made to deceive: a CheckpointError, or what was saved."""

import json

import numpy as np
import pytest
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from usvlearn import AID, Ensemble, Online, Robust
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError

NAMES = ("schema", "estimator", "kernel", "boat", "run", "step", "sha256", "kind", "a.b", "é", "")
NUMBERS = (None, True, 0, 1, 2, -1, 10**30, 0.5, float("nan"), float("inf"), "", "AID", "x" * 300, "\ud800", [], {})
DTYPES = ("F64", "F32", "F16", "BF16", "F8_E4M3", "I64", "U8", "BOOL", "C64", "X", "")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """A checkpoint as it was saved."""
    ensemble = Ensemble({"aid": AID(28.0), "robust": Robust(AID(28.0, gain=3.0))})
    path = Online(ensemble, backend="torch").save(tmp_path_factory.mktemp("set") / "a.safetensors", boat="heron")
    return path.read_bytes()


def damaged(rng, content: bytes) -> bytes:
    """A file with bits flipped, cut, longer, or with a stretch from elsewhere."""
    array = np.frombuffer(content, np.uint8).copy()
    head = 8 + int.from_bytes(content[:8], "little")
    what, place = rng.integers(5), rng.integers(len(array) if rng.random() < 0.5 else head)
    if what < 2:
        places = rng.integers(0, len(array) if what else head, rng.integers(1, 4))
        array[places] ^= (1 << rng.integers(0, 8, len(places))).astype(np.uint8)
    elif what == 2:
        array = array[:place]
    elif what == 3:
        array = np.insert(array, place, rng.integers(0, 256, rng.integers(1, 9)))
    else:
        length = rng.integers(1, 64)
        begin = rng.integers(len(array) - length)
        array[place : place + length] = array[begin : begin + length][: len(array) - place]
    return array.astype(np.uint8).tobytes()


@pytest.mark.fuzz(cases=500, slow=20_000)
def test_damage_is_noticed(rng, cases, whole, tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(whole)
    leaves, facts = checkpoint.load(path)
    noticed = 0
    for _ in range(cases):
        path.write_bytes(damaged(rng, whole))
        try:
            arrays, about = checkpoint.load(path)
        except CheckpointError as error:
            assert str(error).startswith(f"{path}: ") and len(str(error)) < 2000
            noticed += 1
            continue
        assert about == facts and arrays.keys() == leaves.keys()
        assert all(np.array_equal(arrays[name], leaf, equal_nan=True) for name, leaf in leaves.items())
    print(f"{noticed} of {cases} were noticed")
    assert noticed > 0.9 * cases


def value(rng, depth: int = 0):
    """Anything that JSON can say."""
    what = rng.integers(6 if depth < 4 else 4)
    if what < 4:
        return NUMBERS[rng.integers(len(NUMBERS))]
    several = [value(rng, depth + 1) for _ in range(rng.integers(4))]
    return several if what == 4 else {NAMES[rng.integers(len(NAMES))]: each for each in several}


def forged(rng, content: bytes) -> bytes:
    """A file whose header or metadata were changed, and whose checksum fits again, where it can be read at all."""
    size = int.from_bytes(content[:8], "little")
    header, data = json.loads(content[8 : 8 + size]), content[8 + size :]
    facts = json.loads(header["__metadata__"][checkpoint.KEY])
    del facts["sha256"]
    name = list(header)[rng.integers(len(header))]
    what = rng.integers(7)
    if what == 0 and name != "__metadata__":
        header[name]["dtype"] = DTYPES[rng.integers(len(DTYPES))]
    elif what == 1 and name != "__metadata__":
        shapes = [[], [0], [1], [9], [3, 3], [-1], [2**63], [0, 2**62], [1] * 70, header[name]["shape"][::-1]]
        header[name]["shape"] = shapes[rng.integers(len(shapes))]
    elif what == 2 and name != "__metadata__":
        header[name]["data_offsets"] = [[0, 0], [0, 8], [-8, 0], [8, 0], [0, 2**64 - 1]][rng.integers(5)]
    elif what == 3:
        header["x" * rng.integers(3)] = header.pop(name)
    elif what == 4:
        facts = value(rng)
    else:
        facts[NAMES[rng.integers(len(NAMES))]] = value(rng)
    try:
        leaves = load_tensors(made(header, data))
        if isinstance(facts, dict):
            facts.pop("sha256", None)
            facts["sha256"] = checkpoint._digest(leaves, facts)
        if "__metadata__" in header:
            header["__metadata__"] = {checkpoint.KEY: json.dumps(facts)}
        return made(header, data) if what < 4 else save_tensors(leaves, {checkpoint.KEY: json.dumps(facts)})
    except (SafetensorError, ValueError, KeyError, OverflowError):
        return made(header, data)


def made(header: dict, data: bytes) -> bytes:
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


@pytest.mark.thorough
@pytest.mark.fuzz(cases=500, slow=10_000)
def test_forged_files_are_refused_or_legal(rng, cases, whole, tmp_path):
    """By `load`, `Online.open` and `Online.restore`; a folder falls back to the checkpoint before."""
    (tmp_path / "1.safetensors").write_bytes(whole)
    path = tmp_path / "2.safetensors"
    boat = Online.open(tmp_path / "1.safetensors")
    counts = {"refused": 0, "loaded": 0, "opened": 0}
    for _ in range(cases):
        path.write_bytes(forged(rng, whole))
        for kind, read in {"loaded": checkpoint.load, "opened": Online.open, "": boat.restore}.items():
            try:
                read(path)
                counts[kind or "opened"] += 1
            except CheckpointError as error:
                assert str(error).startswith(f"{path}: ") and len(str(error)) < 2000
                counts["refused"] += 1
    print(counts)
    assert min(counts.values()) > cases / 20
