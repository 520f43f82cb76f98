"""What must not happen in a step on an accelerator: numbers that come from the host, or tensors that stay there."""

from typing import Any

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
            copied = [x for x in _parts(args[1]) if isinstance(x, list | np.ndarray)]
            assert not copied, f"the index {copied[0]!r:.60} is copied from the host"
        return func(*args, **(kwargs or {}))


class _NoneOnTheHost(TorchDispatchMode):
    """Refuses operations that make a tensor with axes on the CPU; a number without axes may be there."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        for x in tree_leaves(found):
            if isinstance(x, Tensor):
                assert x.device.type != "cpu" or x.ndim == 0, f"{func} makes a tensor {tuple(x.shape)} on the CPU"
        return found


class OnDevice:
    """Steps inside this context keep to the device of their arguments.

    >>> x = torch.zeros(3, device="meta")
    >>> with OnDevice():
    ...     x.new_tensor([1.0, 2.0])
    Traceback (most recent call last):
    AssertionError: new_tensor([1.0, 2.0]) is copied from the host
    """

    def __enter__(self) -> None:
        self._modes = _NoneFromTheHost(), _NoneOnTheHost()
        for mode in self._modes:
            mode.__enter__()

    def __exit__(self, *error: Any) -> None:
        for mode in reversed(self._modes):
            mode.__exit__(*error)


def _parts(index: Any) -> tuple[Any, ...]:
    return index if isinstance(index, tuple) else (index,)
