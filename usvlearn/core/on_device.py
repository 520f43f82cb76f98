"""Compiles kernels as device functions of CUDA, from the same source.

Numba-cuda would take functions of `core.jit`, but with all of its fast mathematics, where NaN means nothing. And some
of what they use is unknown there. So other functions stand behind the names.
"""

from __future__ import annotations

import ast
import inspect
import math
import os
from enum import EnumMeta
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"  # numba computes in Python, for tests
SAME = ("sqrt", "exp", "expm1", "log", "floor", "sin", "cos", "isnan", "isfinite")  # of `math` as of NumPy
FUNCTIONS = {  # those of CUDA drop NaN; these give of NaN and a number the first, as Python's, and numba's on the CPU
    "min": lambda x, y: y if y < x else x,
    "max": lambda x, y: y if y > x else x,
    "sign": lambda x: x * 0 + 1 if x > 0 else (x * 0 - 1 if x < 0 else x),
}


def imported() -> Any:
    """The module `numba.cuda`."""
    if not SIMULATED:
        import_module("numba_cuda")  # what numba has of its own is too old
    if not hasattr(np, "row_stack"):  # NumPy 2.5 has none, and numba-cuda 0.30 asks for it
        np.row_stack = np.vstack
    from numba import cuda

    return cuda


def obstacle() -> str | None:
    """Why there is no GPU to compute on, and what to do; None where there is one."""
    try:
        imported().current_context()
    except Exception as error:  # of a package or a driver that is missing, broken or too old
        cause = " ".join(str(error).split())
        return f'no GPU can be used ({cause}): it needs pip install "usvlearn[cuda]", and a GPU that nvidia-smi shows'
    return None


class Device(dict):
    """Device functions by the compiled functions that they are made of; with `inline` they are all inlined."""

    def __init__(self, inline: bool):
        self.inline, self.np = inline, _numbers(np, "nan", "inf", "pi", "finfo", "int64", "float64")
        self.names = {name: self.jit(function, True) for name, function in FUNCTIONS.items()}
        self.names["matrix"] = self.jit(lambda x, n, m: x.reshape(n, m), True) if SIMULATED else _matrix()
        vars(self.np).update({name: getattr(math, name) for name in SAME}, sign=self.names["sign"])

    def jit(self, function: Any, inline: bool) -> Any:
        """A device function of a Python function, without fast mathematics."""
        return imported().jit(function, device=True, **({} if SIMULATED else {"forceinline": inline}))

    def __missing__(self, function: Any) -> Any:
        code, names = _code(function.py_func), function.py_func.__globals__ | self.names
        inline = self.inline or bool(function.targetoptions.get("forceinline"))
        self[function] = self.jit(FunctionType(code, names), inline)
        for name in (names.keys() & {*code.co_names}) - self.names.keys():
            if isinstance(value := names[name], Dispatcher):
                names[name] = self[value]
            elif isinstance(value, EnumMeta):  # its members are no indices there, but numbers are
                names[name] = _numbers(value, *value.__members__)
            else:
                names[name] = self.np if value is np else int(value) if isinstance(value, int) else value
        return self[function]


def _numbers(source: Any, *names: str) -> ModuleType:
    """A module with some names of another, or of an IntEnum."""
    module, values = ModuleType("numbers"), {name: getattr(source, name) for name in names}
    vars(module).update({name: int(x) if isinstance(x, int) else x for name, x in values.items()})
    return module


def _code(function: FunctionType) -> Any:
    """The code of a function, with `matrix(x, n, m)` for `x.reshape(n, m)`."""
    if "reshape" not in function.__code__.co_names:
        return function.__code__
    names: dict[str, Any] = {}
    tree = ast.parse(inspect.getsource(function))
    tree.body[0].decorator_list = []  # type: ignore[attr-defined]  # a function
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "reshape":
            node.args.insert(0, node.func.value)
            node.func = ast.Name("matrix", ast.Load())
    exec(compile(ast.fix_missing_locations(tree), function.__code__.co_filename, "exec"), names)
    return names[function.__name__].__code__


def _matrix() -> Any:
    """A function that views a vector as a matrix: CUDA's `reshape` is a slow call, and takes no strided array.

    Of a vector without gaps the stride is a constant, so that small matrices stay in registers.
    """
    from numba.cuda.extending import intrinsic

    arrays, types = (import_module(f"numba.cuda.{name}") for name in ("np.arrayobj", "types"))

    @intrinsic
    def matrix(context, x, n, m):
        kind = types.Array(x.dtype, 2, "C" if x.layout == "C" else "A", readonly=not x.mutable)

        def code(target, builder, signature, arguments):
            source = arrays.make_array(x)(target, builder, arguments[0])
            array = arrays.make_array(kind)(target, builder)
            wide = [target.cast(builder, x, y, types.intp) for x, y in zip(arguments[1:], (n, m), strict=True)]
            stride = builder.extract_value(source.strides, 0)
            if x.layout == "C":
                stride = target.get_constant(types.intp, target.get_abi_sizeof(target.get_data_type(x.dtype)))
            strides = [builder.mul(stride, wide[1]), stride]
            arrays.populate_array(array, source.data, wide, strides, source.itemsize, source.meminfo, source.parent)
            return array._getvalue()

        return kind(x, n, m), code

    return matrix
