"""A member without a kernel: kernels find its prediction in a column of their own behind each prepared sample.

They keep no state of it: that of its class stands beside theirs in a checkpoint.
"""

from __future__ import annotations

from typing import NamedTuple

from usvlearn.core.family import Family, Options, Parameters, Range


class NoState(NamedTuple):
    """Nothing."""


class Choice(Options):
    """What the kernels are told."""

    COLUMN = Range(0, 1023)  # of its prediction, among those of such members


FAMILY = Family(("external",), lambda _: NoState(), Parameters, Choice)
