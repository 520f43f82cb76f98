"""Values that JSON can have."""

from __future__ import annotations

import math
from typing import Any

from usvlearn.errors import printable


def finite(value: Any) -> Any:
    """JSON values, in which a number that is not finite becomes None, and text cannot control a terminal."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return printable(value) if isinstance(value, str) else value
