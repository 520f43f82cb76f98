"""What mypy must refuse and accept of the public names: to it an ignore without an error is an error.

No test runs this file.
"""

from typing import assert_type

from torch import Tensor

import usvlearn
from usvlearn.learned import AlignedLogs, Learned


def refused(logs: AlignedLogs) -> None:
    usvlearn.Positive("x")  # type: ignore[arg-type]  # a word is no number
    usvlearn.AID(mass=28.0, gain="x")  # type: ignore[arg-type]
    usvlearn.RLS(usvlearn.AID())  # type: ignore[arg-type]  # an estimator is no model
    usvlearn.read(3)  # type: ignore[arg-type]  # nor is a number a path
    usvlearn.read("log.csv", mass="28")  # type: ignore[arg-type]
    usvlearn.learn("log.csv")  # type: ignore[arg-type]  # logs are read first
    usvlearn.nothing  # type: ignore[attr-defined]  # noqa: B018


def accepted(logs: AlignedLogs) -> None:
    usvlearn.Positive([[0.1], [1.0]])
    assert_type(usvlearn.AID([28.0, 30.0], gain=[[0.1], [1.0]]).spread, Tensor)
    usvlearn.RLS(usvlearn.SurgeDynamics(28.0))
    assert_type(usvlearn.read({"anna": "logs/anna"}, "alog", align={"dt": 0.2}), AlignedLogs)
    assert_type(usvlearn.learn(logs, usvlearn.AID(mass=28.0)), Learned)
