"""Replaces what JSON cannot hold, such as numbers that are not finite."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from usvlearn.errors import printable


def finite(value: Any, digits: int | None = None) -> Any:
    """JSON values with so many digits, also of arrays; not finite is None, and no text controls a terminal."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return None if not math.isfinite(value) else value if digits is None else float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {str(key): finite(each, digits) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each, digits) for each in value]
    return printable(value) if isinstance(value, str) else value
