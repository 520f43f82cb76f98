"""Dispatch tables: one function for each verb of the kernels, which calls that of the row's family.

The functions are written here from the list of families, as a chain of `if node[0] == 0: return predict_0(…)`. Numba
inlines such a chain; it could not inline a call through a table of functions. The arguments of the verbs are

    node      the row of this estimator in the table (`usvlearn.core.family`)
    s, q      the state and the numbers of a batch element
    x         the inputs of the step (`usvlearn.core.prepared_samples`)
    work      an array of the length that the family declares; `predict` may leave there what `learn` needs
    surge     measured speed, m/s, with which a segment starts
    predicted the first value of `predict`: the prediction, m/s
    estimate  its second value: the same before its limits
    target    the speed to learn, m/s
    factor    the factor by which a covariance is inflated
"""

from collections.abc import Container
from importlib import import_module
from typing import Any

from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators import COMPILED

VERBS = {
    "start": "node, s, q, surge",
    "predict": "node, s, q, x, work",
    "coast": "node, s, q, x, predicted, work",
    "learn": "node, s, q, x, estimate, target, work",
    # Without one of its own, a family makes a step of an open-loop simulation by `predict` and `coast`.
    "free_step": "node, s, q, x, work",
    # Optional: only a family with a covariance has the first; the second is a faster loop over all steps of one batch
    # element.
    "inflate_covariance": "node, s, q, factor",
    "run_alone": "node, s, q, rows, free, predictions, picked, picks, work",
}
KERNELS = [import_module(f"usvlearn.estimators.{name}.kernel") for name in COMPILED]


SHORT = ("start", "predict", "coast")  # short functions: a call would take longer than they do


def having(verb: str) -> dict[int, Any]:
    """The functions of a verb by the index of the family, for families that have it."""
    return {k: getattr(kernel, verb) for k, kernel in enumerate(KERNELS) if hasattr(kernel, verb)}


COASTED = """
@jit
def free_step(node, s, q, x, work):
    predicted, _ = predict(node, s, q, x, work)
    coast(node, s, q, x, predicted, work)
    return predicted
"""


def free_step_of(kernel: Any) -> Any:
    """A family's `free_step`, or one that is made of its `predict` and `coast`."""
    if hasattr(kernel, "free_step"):
        return kernel.free_step
    names = {"__name__": kernel.__name__, "jit": jit, "predict": kernel.predict, "coast": kernel.coast}
    exec(compile(COASTED, kernel.__file__, "exec"), names)
    return names["free_step"]


def bits(verb: str) -> int:
    """The families that have a verb, as a bit mask."""
    return sum(1 << k for k in having(verb))


def chain(verb: str, families: Container[int] = range(len(KERNELS))) -> Any:
    """The function of a verb, for some families."""
    every = dict(enumerate(map(free_step_of, KERNELS))) if verb == "free_step" else having(verb)
    functions = {k: function for k, function in every.items() if k in families}
    lines = [f"def {verb}({VERBS[verb]}):"]
    for k in functions:
        call = f"return {verb}_{k}({VERBS[verb]})"
        last = k == max(functions)
        lines += [f"    {call}"] if last else [f"    if node[{Row.FAMILY:d}] == {k}:", f"        {call}"]
    if verb in SHORT:
        functions = {k: jit(getattr(each, "py_func", each), inline=True) for k, each in functions.items()}
    names = {"__name__": __name__, **{f"{verb}_{k}": function for k, function in functions.items()}}
    exec(compile("\n".join(lines if functions else [*lines, "    pass"]), __file__, "exec"), names)
    return jit(names[verb], inline=True)


start, predict, coast, learn, free_step, inflate_covariance, run_alone = map(chain, VERBS)
INFLATES, ALONE = bits("inflate_covariance"), bits("run_alone")
