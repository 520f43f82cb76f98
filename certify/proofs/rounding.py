"""Round bounds in the direction in which they remain true: upper bounds up, lower bounds down."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction

PLAIN = range(-6, 16)  # decimal exponents that are written without e


def float_above(x: Fraction) -> float:
    """The least float that is not below a number."""
    try:
        near = float(x)
    except OverflowError:
        near = math.inf if x > 0 else -math.inf
    return (near if near >= x else math.nextafter(near, math.inf)) + 0.0  # −0, where x underflows, becomes 0


def float_below(x: Fraction) -> float:
    """The greatest float that is not above a number."""
    return 0.0 - float_above(-x)  # 0 is never −0


def above(x: Fraction | float, digits: int = 6) -> str:
    """A decimal that is not below a number. It has more digits where a number below 1 would be shown as 1."""
    return _decimal(Fraction(x), digits, ROUND_CEILING)


def below(x: Fraction | float, digits: int = 6) -> str:
    """A decimal that is not above a number."""
    return _decimal(Fraction(x), digits, ROUND_FLOOR)


def _decimal(x: Fraction, digits: int, rounding: str) -> str:
    """Divide in a separate context, because the operators of Decimal round to 28 digits, half-even."""
    while True:
        context = Context(prec=digits, rounding=rounding)
        value = context.divide(Decimal(x.numerator), Decimal(x.denominator))  # rounds once, from the exact integers
        if x >= 1 or value != 1:
            break
        digits += 1
    value = value.normalize(context)
    if not value:
        return "0"
    return f"{value:f}" if value.adjusted() in PLAIN else f"{value:e}"
