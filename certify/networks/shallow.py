"""The weights of a shallow ReLU network with one state, and the files they are read from.

    x⁺ = aᵀ relu(w₁ x + W₂ u + b)                                                 (paper, section IV-B)

torch is imported only to read a file that torch wrote. Certificates are checked without it.
"""

from __future__ import annotations

import glob
import hashlib
import json
import math
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError, quoted, shortened

SUFFIXES = (".safetensors", ".npz", ".pt", ".pth")
LARGEST = 1e150  # largest weight in a file; sums of products of two such weights are still finite floats
NAMED = re.compile(r"(^|\.)w1$")
UNPACKED = 2**28  # bytes to which an archive may unpack: 30 million weights


class ShallowWeights(NamedTuple):
    """The weights of x⁺ = aᵀ relu(w₁ x + W₂ u + b), n neurons and m inputs; arrays or tensors.

    >>> ShallowWeights(a=[0.5], w1=[1.0], W2=[[0.0]], b=[0.0]).w1
    [1.0]
    """

    a: Any  # (*batch, n)
    w1: Any  # (*batch, n)
    W2: Any  # (*batch, n, m)
    b: Any  # (*batch, n)


NAMES = ShallowWeights._fields


class Network(NamedTuple):
    """One checkpoint, and the place from which it was read."""

    path: str  # of the file; with the tensors' prefix or the batch element if a file contains more than one checkpoint
    weights: ShallowWeights  # float64 arrays, no batch
    tensors: str = ""  # before the names of its tensors (`members.rnn.weights`), and the index of several

    @property
    def inputs(self) -> int:
        """m."""
        return int(self.weights.W2.shape[-1])


def check(weights: ShallowWeights, name: str = "weights") -> ShallowWeights:
    """The weights as float64 arrays, `(*batch, …)`; a CertifyError as of `as_float64`, or if shapes do not fit."""
    arrays = ShallowWeights(**as_float64(dict(zip(NAMES, weights, strict=True)), name))
    shapes = {key: array.shape for key, array in zip(NAMES, arrays, strict=True)}
    shape = arrays.a.shape
    if not shape or arrays.w1.shape != shape or arrays.b.shape != shape or arrays.W2.shape[:-1] != shape:
        listed = ", ".join(f"{key} {value}" for key, value in shapes.items())
        raise CertifyError(f"{name}: found the shapes {listed}, expected a, w1, b (n,) and W2 (n, m)")
    if shape[-1] == 0:
        raise CertifyError(f"{name}: found a network without neurons, expected n of 1 or more")
    return arrays


def as_float64(values: Mapping[str, Any], name: str) -> dict[str, np.ndarray]:
    """Named weights as float64 arrays.

    A CertifyError about one that is NaN, infinite or no number, or that is changed by the conversion: an integer beyond
    2⁵³, a long double.
    """
    try:
        given = {key: np.asarray(x) for key, x in values.items()}
        if kinds := {x.dtype.kind for x in given.values()} - set("fiub"):
            raise TypeError(f"kind {', '.join(sorted(kinds))}")
        with np.errstate(over="ignore", invalid="ignore"):
            arrays = {key: x.astype(np.float64) for key, x in given.items()}
            lost = [key for key, x in given.items() if not _same(x, arrays[key])]
    except (TypeError, ValueError) as error:
        raise CertifyError(
            f"{name}: found weights that are no numbers ({shortened(error)}), expected float arrays"
        ) from error
    if lost:
        raise CertifyError(
            f"{name}: found values in {', '.join(lost)} that float64 cannot hold exactly, expected float64 values: "
            "convert them to float64 before, since a proof is about the exact weights"
        )
    for key, array in arrays.items():
        if count := int((~np.isfinite(array)).sum()):
            raise CertifyError(f"{name}: found {count} NaN or infinite values in {key}, expected finite weights")
    return arrays


def _same(given: np.ndarray, converted: np.ndarray) -> bool:
    """Whether a conversion to float64 has changed no finite value: float16, float32 and small integers survive it."""
    if given.dtype.kind == "f":
        return bool(((given == converted) | ~np.isfinite(given)).all())
    return all(int(x) == int(y) for x, y in zip(given.ravel().tolist(), converted.ravel().tolist(), strict=True))


def digest(weights: ShallowWeights) -> str:
    """The sha256 of one network's weights, which a certificate is about."""
    total = hashlib.sha256()
    for name, array in zip(NAMES, check(weights), strict=True):
        total.update(f"{name}{array.shape}".encode() + np.ascontiguousarray(array + 0.0).astype("<f8").tobytes())
    return total.hexdigest()


def from_tensors(tensors: Mapping[str, Any], path: str = "tensors", most: float = math.inf) -> list[Network]:
    """Every shallow network among named tensors, one batch element after the other.

    Names end in `a`, `w1`, `W2`, `b` after a common prefix (`members.rnn.weights.a`). Two linear layers are accepted,
    too: the first with (n, 1 + m) weights, those of the state in column 0, the second with (1, n) and no bias. There
    may be `most` networks.
    """
    prefixes = [name.removesuffix("w1") for name in tensors if NAMED.search(name)]
    for prefix in prefixes:
        if lacking := [prefix + name for name in NAMES if prefix + name not in tensors]:
            raise CertifyError(
                f"{path}: holds {prefix}w1 but no {', '.join(lacking)}: expected a, w1, W2 and b together"
            )
    named = [(prefix.rstrip("."), ShallowWeights(*(tensors[prefix + name] for name in NAMES))) for prefix in prefixes]
    named = named or [("", weights) for weights in _two_layers(tensors, path)]
    if not named:
        raise CertifyError(
            f"{path}: holds no shallow network (it holds: {shortened(', '.join(tensors)) or 'nothing'}): expected "
            "tensors named a, w1, W2 and b, or two linear layers"
        )
    networks: list[Network] = []
    for prefix, weights in named:
        label = path if len(named) == 1 else f"{path}:{prefix}"
        arrays = check(weights, label)
        if (size := max(np.abs(x).max(initial=0.0) for x in arrays)) > LARGEST:
            raise CertifyError(f"{label}: found a weight of {size:.3g}, expected none above {LARGEST:g}")
        refuse_many(len(networks) + math.prod(arrays.a.shape[:-1]), most, label)
        elements = list(np.ndindex(arrays.a.shape[:-1]))
        if not elements:
            raise CertifyError(f"{label}: holds no network, found a of the shape {arrays.a.shape}")
        for element in elements:
            suffix = "" if len(elements) == 1 else f"[{','.join(map(str, element))}]"
            networks.append(Network(label + suffix, ShallowWeights(*(x[element] for x in arrays)), prefix + suffix))
    return networks


def refuse_many(count: int, most: float, path: str) -> None:
    """Refuse more than `most` checkpoints, before any of them is compared with a certificate."""
    if count > most:
        raise CertifyError(
            f"{path}: found {count} checkpoints, expected at most {most} for --verify: save the ones that the "
            "certificates are about"
        )


def holds_shallow(tensors: Iterable[str]) -> bool:
    """Whether a name among them is that of a shallow network's w1."""
    return any(map(NAMED.search, tensors))


def _two_layers(tensors: Mapping[str, Any], path: str) -> Iterator[ShallowWeights]:
    layers = [(name.removesuffix("weight"), x) for name, x in tensors.items() if re.search(r"(^|\.)weight$", name)]
    if len(layers) != 2 or any(np.ndim(x) != 2 for _, x in layers):
        return
    (first, W), (second, a) = layers
    W, a = np.asarray(W), np.asarray(a)
    offset = tensors.get(f"{second}bias")
    if a.shape != (1, len(W)) or W.shape[1] < 1:
        raise CertifyError(
            f"{path}: found linear layers of the shapes {W.shape} and {a.shape}, expected (n, 1 + m) and (1, n)"
        )
    if offset is not None and np.any(np.asarray(offset)):
        raise CertifyError(f"{path}: {second}bias is not zero, expected x⁺ = aᵀ relu(…) without an offset")
    b = tensors.get(f"{first}bias")
    yield ShallowWeights(a[0], W[:, 0], W[:, 1:], np.zeros(len(W)) if b is None else b)


def load(path: str | Path) -> list[Network]:
    """The checkpoints in a file: a checkpoint or other `.safetensors`, an `.npz`, a torch `state_dict`.

    No pickled code is run, whatever the file holds.

    Args:
        path: of the file.

    Returns:
        The networks, one for each checkpoint that the file holds.

    Raises:
        CertifyError: no such file, of another kind, damaged, or without a shallow network.

    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(f"{folder}/net.npz", a=[0.5], w1=[1.0], W2=[[0.0]], b=[0.0])
    ...     load(f"{folder}/net.npz")[0].weights.a
    array([0.5])
    """
    networks = from_tensors(read_tensors(path), str(path))
    if (stated := stated_activation(path)) not in (None, "relu"):
        raise CertifyError(f"{path}: states the activation {quoted(stated)}, expected relu")
    return networks


def read_tensors(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors in a file by name; a CertifyError without a file, or of another kind, or damaged."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise CertifyError(f"{path}: is no checkpoint: expected a file that ends in {', '.join(SUFFIXES)}")
    reader = {".safetensors": _read_safetensors, ".npz": _read_npz}.get(path.suffix, _read_torch)
    try:
        with path.open("rb"):
            pass
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(each.file_size for each in archive.infolist())
            if unpacked > UNPACKED:
                raise CertifyError(
                    f"{path}: unpacks to {unpacked / 1e6:.0f} MB, expected {UNPACKED / 1e6:.0f} MB at most: save the "
                    "weights alone"
                )
        tensors = reader(path)
    except CertifyError:
        raise
    except OSError as error:
        raise CertifyError(f"{path}: cannot be read ({error.strerror or error}): give the path of a file") from error
    except Exception as error:  # a damaged file can make a reader raise anything
        cause = shortened(error) or type(error).__name__
        raise CertifyError(f"{path}: cannot be read as {path.suffix} of float32 or float64 ({cause})") from error
    return tensors


def stated_activation(path: str | Path) -> str | None:
    """The activation that a file states, None where it states none; a CertifyError as of `read_tensors`.

    It is an entry `activation` of an .npz or of the metadata of .safetensors, or of the descriptions of estimators with
    which usvlearn saves a checkpoint; version 0.2 wrote it beside these.
    """
    path = Path(path)
    if path.suffix == ".npz":
        text = read_tensors(path).get("activation")
        return None if text is None else str(text)
    if path.suffix != ".safetensors":
        return None
    from safetensors import safe_open

    try:
        with safe_open(path, "np") as file:
            known = file.metadata() or {}
        facts = json.loads(known.get("usvlearn", "{}"))
        stated = {known["activation"]} if "activation" in known else set(_stated(facts))
    except Exception as error:  # a damaged file can make a reader raise anything
        raise CertifyError(f"{path}: its metadata cannot be read ({shortened(error)}): save it again") from error
    if len(stated) > 1:
        raise CertifyError(f"{path}: states the activations {quoted(sorted(stated))}, expected one")
    return next(iter(stated), None)


def _stated(facts: Any) -> Iterator[str]:
    """Every `activation` in nested dictionaries."""
    for key, value in facts.items() if isinstance(facts, dict) else ():
        if key == "activation":
            yield str(value)
        yield from _stated(value)


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    return load_file(path)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no zip archive")
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _read_torch(path: Path) -> dict[str, np.ndarray]:
    import torch

    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CertifyError(f"{path}: is damaged, or holds more than tensors: save model.state_dict()") from error
    if isinstance(tensors, Mapping) and isinstance(tensors.get("state_dict"), Mapping):
        tensors = tensors["state_dict"]
    if not (isinstance(tensors, Mapping) and all(isinstance(x, torch.Tensor) for x in tensors.values())):
        raise CertifyError(f"{path}: found {type(tensors).__name__}, expected tensors by name: save model.state_dict()")
    return arrays_of(tensors, str(path))


def arrays_of(tensors: Mapping[str, Any], path: str) -> dict[str, np.ndarray]:
    """Tensors of torch as arrays; those of less than 64 bits as float64, exactly. Complex ones are refused."""
    if kinds := {str(x.dtype) for x in tensors.values() if x.is_complex()}:
        raise CertifyError(f"{path}: found {', '.join(kinds)}, expected real weights")
    floats = {name: x.double() if x.is_floating_point() else x for name, x in tensors.items()}
    return {str(name): x.detach().cpu().numpy() for name, x in floats.items()}


def find(paths: Iterable[str | Path]) -> list[Path]:
    """The files of checkpoints named by files, folders (of a run: its checkpoints) and patterns, each once."""
    distinct: dict[Path, Path] = {}
    for path in matched(paths):
        files = [path] if not path.is_dir() else below(path)
        if not files:
            raise CertifyError(f"{path}: holds no checkpoints, expected files {', '.join(SUFFIXES)}")
        for file in files:
            distinct.setdefault(file.resolve(), file)
    return list(distinct.values())


def matched(paths: Iterable[str | Path]) -> Iterator[Path]:
    """The files and folders that paths and patterns name; a CertifyError if one of them names nothing."""
    for given in map(str, paths):
        if not given:
            raise CertifyError("found an empty PATH, expected checkpoints, a run's folder or a pattern")
        places = [Path(given)] if Path(given).exists() else sorted(map(Path, glob.glob(given, recursive=True)))
        if not places:
            raise CertifyError(f"{given}: no such file, folder or pattern: give checkpoints, or a run's folder")
        yield from places


def below(folder: Path) -> list[Path]:
    """The checkpoints below a folder. Of a run's folder only `checkpoints/` is read, not predictions, reports, or what
    holds the same networks beside others (`planar/`).
    """
    files = sorted(path for path in folder.rglob("*") if path.suffix in SUFFIXES and path.is_file())
    runs = {path.parent for path in [folder / "checkpoints", *folder.rglob("checkpoints")] if path.is_dir()}

    def kept(path: Path) -> bool:
        run = next((parent for parent in reversed(path.parents) if parent in runs), None)
        return run is None or path.is_relative_to(run / "checkpoints")

    return [path for path in files if kept(path)]
