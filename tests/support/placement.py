"""What must not happen in a step on an accelerator, and a stand-in for one: the device `meta`, which has no values."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

MADE_FROM_DATA = {"tensor", "as_tensor", "asarray", "new_tensor", "from_numpy"}


class _NoneFromTheHost(TorchFunctionMode):
    """Refuses tensors of Python numbers or arrays, and indices that are lists: each is copied to the device anew.

    A copy from the host waits for the device, and no CUDA graph can contain it. `torch.full` and its kin are no copies.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in MADE_FROM_DATA:
            data = args[1] if name == "new_tensor" else args[0]
            assert isinstance(data, Tensor), f"{name}({data!r:.60}) is copied from the host"
        if name in ("__getitem__", "__setitem__"):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            copied = [x for x in index if isinstance(x, list | np.ndarray)]
            assert not copied, f"the index {copied[0]!r:.60} is copied from the host"
        return func(*args, **(kwargs or {}))


class _NoneOnTheHost(TorchDispatchMode):
    """Refuses operations that make a tensor with axes on the CPU; a number without axes may be there."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves(result):
            if isinstance(x, Tensor):
                assert x.device.type != "cpu" or x.ndim == 0, f"{func} makes a tensor {tuple(x.shape)} on the CPU"
        return result


@contextmanager
def on_device() -> Iterator[None]:
    """Fails where steps inside it do not keep to the device of their arguments.

    >>> with on_device():
    ...     torch.zeros(3, device="meta").new_tensor([1.0, 2.0])
    Traceback (most recent call last):
    AssertionError: new_tensor([1.0, 2.0]) is copied from the host
    """
    with _NoneFromTheHost(), _NoneOnTheHost():
        yield


@contextmanager
def read_as_ones() -> Iterator[None]:
    """Every value that is read from `meta` is 1, so that code which reads results can be run to its end.

    >>> with read_as_ones():
    ...     torch.zeros(2, device="meta").tolist()
    [1.0, 1.0]
    """
    with ExitStack() as stack:
        for name in ("cpu", "item", "tolist", "__float__", "__bool__"):
            stack.enter_context(patch.object(Tensor, name, _reading(getattr(Tensor, name))))
        yield


def _reading(method: Any) -> Any:
    return lambda x: method(torch.ones(x.shape, dtype=x.dtype) if x.is_meta else x)
