"""The compiled backend: it makes the same steps on the same states as torch, equal to rounding, and imports no torch.

The engine knows the layout of no family. Each declares its own (`usvlearn.core.family`), and its `kernel.py` makes its
steps. A table describes the parts of an estimator, and the kernels interpret it, so another ensemble needs no new
compilation. A state is one row of numbers per batch element; its leaves are views of that row. The files, in the order
in which they build on each other:

    dispatch_tables    one function for each verb, which calls the kernel of the right family
    dispatch      one estimator, one ensemble, one step; runs over (time, elements)
    parts         one walk of a description: its parts, their leaves and numbers
    program       from the parts to the table, the numbers and the places of the leaves
    validate      checks a description and a state from a file
    first_use, background_compile    compile what runs and live steps need together, in a second process
    run, single_steps, open_loop_scores    runs over samples, single steps, scored simulations, of arrays
    lanes, fit_member    runs on a GPU; a batch fit joins the forecasts
    planar        the steps of sway and yaw rate beside the surge's, and tracks
    external      members that other code steps, before the kernels
    backend, torch_steps    who makes the steps, and single steps by torch
    rollouts, online, identified    what the rest of the library calls
    summary       what a person is told of an `Online`
"""

from collections.abc import Mapping
from typing import Any

import numpy as np


def select_element(description: Any, elements: int, element: int) -> Any:
    """The description of one batch element: where a number differs by batch element, that of this batch element."""
    if not isinstance(description, Mapping):
        return description
    selected = {}
    for key, value in description.items():
        if key in ("numbers", "vectors"):
            axes = int(key == "vectors")  # behind that of the batch elements: a vector's entries
            selected[key] = {
                name: x if np.ndim(x) <= axes else (x[element] if len(x) == elements else x[0])
                for name, x in value.items()
            }
        elif key in ("inner", "forecasts", "fit"):
            selected[key] = select_element(value, elements, element)
        elif key == "table":
            selected[key] = value if np.ndim(value) == 1 else value[element]
        elif key in ("members", "rules") and isinstance(value, Mapping):
            selected[key] = {name: select_element(x, elements, element) for name, x in value.items()}
        else:
            selected[key] = value
    return selected
