"""The state of a Python object as bytes, and back: numbers, text, arrays and containers of them; never pickle.

What cannot be read whole, such as an object of C code, is refused, so that nothing is resumed in part.
"""

from __future__ import annotations

import base64
import json
import zlib
from types import BuiltinFunctionType, FunctionType
from typing import Any

import numpy as np

from usvlearn.errors import CheckpointError

DEEPEST, LARGEST = 20, 2**26  # levels, and bytes of a state
CONTAINERS = {"list": list, "tuple": tuple, "set": set}


def packed(model: Any, size: int) -> np.ndarray:
    """The state of an object, `(size,)` bytes: what its method `get_state` returns, or else all its attributes.

    A TypeError where the object holds what is not plain, a ValueError where it is too long.
    """
    given = model.get_state() if hasattr(model, "get_state") else model
    content = zlib.compress(json.dumps(_plain(given, {}, 0)).encode(), 1)
    if len(content) + 4 > size:
        raise ValueError(f"its state has {len(content)} bytes, expected {size - 4} at most: give a larger state_size")
    buffer = np.zeros(size, np.uint8)
    buffer[: len(content) + 4] = np.frombuffer(len(content).to_bytes(4, "little") + content, np.uint8)
    return buffer


def unpacked(content: np.ndarray, model: Any) -> Any:
    """The object, as it was made, in the state of these bytes; a CheckpointError if they are of another one."""
    length = int.from_bytes(content[:4].tobytes(), "little")
    try:
        unzip = zlib.decompressobj()
        read = json.loads(unzip.decompress(content[4 : 4 + length].tobytes(), LARGEST))
        if hasattr(model, "set_state"):
            model.set_state(_built(read, None))
        elif _built(read, model) is not model:
            raise ValueError("expected attributes")
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"its state does not fit {type(model).__name__} ({error})") from error
    return model


def _plain(value: Any, seen: dict[int, Any], depth: int) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return value.item()
    if isinstance(value, FunctionType | BuiltinFunctionType | type):
        return {"same": value.__qualname__}
    kind = type(value)
    if id(value) in seen or depth > DEEPEST:
        raise TypeError(f"{kind.__name__} is held twice, or too deep")
    if kind is np.ndarray and value.dtype.kind in "biuf" and value.flags.forc:  # its order decides how it is changed
        if any(np.may_share_memory(value, each) for each in seen.values() if isinstance(each, np.ndarray)):
            raise TypeError("two arrays share memory")
        seen[id(value)] = value
        of = {"of": value.dtype.str, "shape": value.shape, "order": "C" if value.flags.c_contiguous else "F"}
        return {"array": base64.b64encode(value.tobytes("A")).decode(), **of}
    seen[id(value)] = value
    if isinstance(value, dict):
        return {"dict": [[_plain(each, seen, depth + 1) for each in pair] for pair in value.items()]}
    for name, container in CONTAINERS.items():
        if kind is container:
            return {name: [_plain(each, seen, depth + 1) for each in value]}  # pyright: ignore[reportGeneralTypeIssues]
    slots = any(getattr(each, "__slots__", ()) for each in kind.__mro__)
    hooks: Any = [vars(each).keys() & {"__reduce__", "__reduce_ex__"} for each in kind.__mro__ if each is not object]
    if not hasattr(value, "__dict__") or slots or any(hooks):
        raise TypeError(f"{kind.__module__}.{kind.__qualname__} is not plain")
    return {"object": {key: _plain(each, seen, depth + 1) for key, each in vars(value).items()}}


def _built(read: Any, before: Any) -> Any:
    """What `_plain` has read; objects, functions and kinds of dictionaries are those of the state before."""
    if not isinstance(read, dict):
        return read
    (name, content), *_ = read.items()
    if name == "array":
        flat, order = np.frombuffer(base64.b64decode(content), np.dtype(read["of"])), read["order"]
        return flat.reshape(read["shape"], order=order).copy(order)
    if name == "dict":
        result = before if isinstance(before, dict) else {}
        pairs = [(_built(key, None), value) for key, value in content]
        built = {key: _built(value, result.get(key)) for key, value in pairs}
        result.clear()
        result.update(built)
        return result
    if name in CONTAINERS:
        fits = isinstance(before, list | tuple) and len(before) == len(content)
        parts = list(before) if fits else [None] * len(content)
        return CONTAINERS[name](_built(*each) for each in zip(content, parts, strict=True))
    if name == "same" and getattr(before, "__qualname__", None) == content:
        return before
    if name != "object" or not hasattr(before, "__dict__"):
        raise ValueError(f"found {name}, where the object has {type(before).__name__}")
    built = {key: _built(value, vars(before).get(key)) for key, value in content.items()}
    vars(before).clear()
    vars(before).update(built)
    return before
