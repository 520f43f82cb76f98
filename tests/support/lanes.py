"""Compares the kernels on a GPU, or in CUDA's simulator, with those on the CPU: python -m tests.support.lanes NAMES.

It prints, for each estimator, the greatest difference of predictions and states, and whether NaN agree. With
`ptx NAMES` it compiles for a GPU that need not be there.
"""

import sys
from types import SimpleNamespace

import numpy as np
import torch

from tests.support import ESTIMATORS
from tests.support.kernel_cases import VARIANTS, difference, mission
from usvlearn import Ensemble, JointEKF, Persistence
from usvlearn.composition.configuration import compose_train, ensemble_of
from usvlearn.core.on_device import imported
from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import tree_map
from usvlearn.engine import lanes
from usvlearn.engine.backend import array_of, arrays_of, tree_of
from usvlearn.engine.program import program_for
from usvlearn.engine.run import roll
from usvlearn.estimators.ensemble.forecasts.fit_layer import FittedForecasts
from usvlearn.estimators.ensemble.forecasts.state import TABLE


def fitted() -> Ensemble:
    """Its forecasts have a batch fit as a member; any table is one."""
    forecasts = FittedForecasts(fit=np.linspace(0.1, 0.3, TABLE).tolist())
    return Ensemble({"joint": JointEKF(2.7, mass=28.0), "persistence": Persistence()}, forecasts=forecasts)


EVERY = ESTIMATORS | VARIANTS | {"default": lambda: ensemble_of(compose_train([])), "fitted": fitted}


@torch.no_grad()
def compared(name: str, dtype: torch.dtype, steps: int) -> tuple[float, bool]:
    """The greatest difference relative to the largest entry of each leaf, and whether NaN agree."""
    estimator = EVERY[name]().to(dtype)
    samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, mission(steps, 3))
    state, arrays = estimator.init((3,)), tree_map(array_of, samples)
    recorded = ["predictions"] if "predictions" in arrays_of(state) else []
    result, expected = (
        roll(spec_of(estimator), arrays_of(state), arrays, record=recorded, device=each) for each in ("cuda", "cpu")
    )
    pairs = [(tree_of(state, result.leaves), tree_of(state, expected.leaves))]
    pairs += [(torch.as_tensor(result.predictions), torch.as_tensor(expected.predictions))]
    pairs += [(torch.as_tensor(result.record[name]), torch.as_tensor(expected.record[name])) for name in recorded]
    same = np.array_equal(np.isnan(result.predictions), np.isnan(expected.predictions))
    return max(difference(x, y) for x, y in pairs), same and bool(np.isfinite(result.predictions).any())


def ptx(name: str, capability: tuple[int, int] = (9, 0)) -> str:
    """The assembly of an estimator's kernel."""
    cuda = imported()
    from numba.cuda import compiler, dispatcher, types

    compiler.get_current_device = dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=capability)

    def array(kind, axes):
        return types.Array(kind, axes, "C")

    whole, number = types.int64, types.float64
    plan = program_for(spec_of(EVERY[name]()), (), np.float64)
    _, kernel = lanes.kernel_of(plan, lanes.own_numbers(plan), np.array([-1, -1]))
    signature = (
        *(array(whole, 2), array(number, 2), array(number, 2), array(number, 2), array(number, 3)),
        *(array(whole, 1), types.boolean, array(number, 1), array(whole, 1)),
        *(array(number, 2), array(number, 3)),
    )
    return cuda.compile_ptx(kernel.py_func, signature, cc=capability)[0]


if __name__ == "__main__":
    if sys.argv[1] == "ptx":
        for name in sys.argv[2:]:
            print(name, len(ptx(name)), "bytes of PTX", flush=True)
    else:
        dtype, steps, *names = sys.argv[1:]
        for name in names or EVERY:
            print(name, dtype, *compared(name, getattr(torch, dtype), int(steps)), flush=True)
