"""Helper kernels, linked into their callers as LLVM code, so that each is compiled once.

Numba optimises each function and makes machine code of it, and does both again inside each function that calls it.
A `Part` skips both: it stays LLVM code and is linked into its callers. It is optimised there once, and only the callers
become machine code. That halves the time to compile the kernels.

This uses internals of numba. Where a version lacks one of them, or is newer than those that were tested, the import of
this module fails, and `jit` compiles parts like all other functions.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from numba import version_info
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

NEWEST = (0, 68)  # the newest numba that this was tested on; in another, the same names may mean something else
USED = {
    JITCodeLibrary: ("_optimize_final_module", "_finalize_final_module", "_finalize_dynamic_globals"),
    NativeLowering: ("run_pass",),
    DefaultPassBuilder: ("define_nopython_pipeline",),
    CPUDispatcher: ("add_overload",),
    Flags: ("no_compile", "options"),
}
if version_info.short > NEWEST or not all(hasattr(owner, name) for owner, names in USED.items() for name in names):
    raise ImportError(f"numba: found {version_info.short}, expected {NEWEST} at most, with known internals")


class _Library(JITCodeLibrary):
    """The code of a part, to be linked into that of its callers."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    """Lowers a part into a `_Library`, and registers it for its callers."""

    _name = "usvlearn_part"

    def run_pass(self, state: Any) -> bool:
        state.library = _Library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        name = object()  # in place of the function that Python would call
        state.targetctx.insert_user_function(name, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=name)
        return True


class _Flags(Flags):
    """Numba's options with a fast comparison: numba's own takes a sixth of the time to compile."""

    __slots__ = ()
    options: dict[str, Any]

    def __hash__(self) -> int:
        return hash(tuple(sorted(self.options)))  # as numba's

    def __eq__(self, other: object) -> bool:
        return self._values == getattr(other, "_values", None) or super().__eq__(other)


class _Compiler(CompilerBase):
    """Numba's own passes, except for the lowering."""

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        self.state.flags = _Flags(self.state.flags)

    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_Lowering if each is NativeLowering else each, why) for each, why in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]


class Part(CPUDispatcher):
    """A function that only compiled functions call; where Python calls it, it is also compiled alone."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any], alone: Callable[..., Any]):
        super().__init__(
            function, targetoptions={"nopython": True, "no_cpython_wrapper": True, **options}, pipeline_class=_Compiler
        )
        self._alone = alone

    @cached_property
    def entry(self) -> Callable[..., Any]:
        """The function as Python calls it."""
        return self._alone(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        return self.entry(*arguments)

    def add_overload(self, cres: Any) -> None:
        """Store the code compiled for some types; Python's dispatcher does not learn of it."""
        self.overloads[tuple(cres.signature.args)] = cres
