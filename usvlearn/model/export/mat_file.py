"""What is known of a boat as a MAT file of version 5, for MATLAB, Octave and Simulink."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from usvlearn.model.export.described import described
from usvlearn.model.read_boats import IdentifiedBoat

LONGEST = 63  # characters of a name in MATLAB


def mat_file(boat: IdentifiedBoat) -> bytes:
    """The content of a file with one variable, the struct `boat`: the fields are those of `BOAT.json`."""
    from scipy.io import savemat

    content = io.BytesIO()
    savemat(content, {"boat": _value(described(boat))}, long_field_names=True, oned_as="column")
    return content.getvalue()


def _value(given: Any) -> Any:
    """A JSON value as MATLAB has it: a struct, a text, a cell of texts, or numbers; null is NaN."""
    if isinstance(given, dict):
        return {_name(key): _value(each) for key, each in given.items()}
    if isinstance(given, str):
        return given.encode("utf-8", "replace").decode()
    if isinstance(given, list) and all(isinstance(each, str) for each in given):
        found = np.empty(len(given), object)
        found[:] = [_value(each) for each in given]
        return found
    if given is None:
        return np.nan
    return np.asarray(given, np.float64 if _numeric(given) else object)


def _numeric(given: Any) -> bool:
    return isinstance(given, int | float | list)


def _name(key: str) -> str:
    """A key as the name of a field.

    >>> _name("steady_speed"), _name("1/s")
    ('steady_speed', 'x1_s')
    """
    found = re.sub(r"\W", "_", key, flags=re.ASCII)[:LONGEST]
    return found if re.match(r"[A-Za-z]", found) else f"x{found}"[:LONGEST]
