"""Reads the fit that `usvlearn fit` wrote beside a run, `RUN/fit/BOAT.fit.json`: a file of others is data."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import printable
from usvlearn.estimators.axis.turning_quantities import OF_FIT
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.quantities import QUANTITIES, SIDES

FOLDER, ENDING = "fit", ".fit.json"  # of a run, and of the name of a boat's file
LARGEST, LONGEST, LETTERS = 30_000_000, 10_000, 300  # bytes of a file, numbers in a list, letters in a text
FEW = 30  # most sentences, sets of terms and courses
ABSURD = 1e9  # no number of a boat is as large
PUSHES = ("mean", "difference")  # of the commands of both sides


class SetOfTerms(NamedTuple):
    """How a set of terms does on missions that it has not learned; NaN where unknown."""

    parameters: float
    gain: float  # loss a step of the used set minus that of this one
    error: float  # its standard error
    mae: float  # m/s


class Mission(NamedTuple):
    """A mission beside its simulation; NaN where unknown."""

    name: str
    steps: float
    minutes: float
    mae: float  # m/s
    fit: float  # percent
    bias: float  # m/s
    current: float  # m/s, its size at the end
    start: float  # s, of the worst minute
    worst: float  # m/s, its mean |error|


class Course(NamedTuple):
    """The worst minute of a mission and what is around it, `(time,)` each; NaN where unknown."""

    name: str
    start: float  # s, of the minute
    time: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    left: np.ndarray
    right: np.ndarray


class Lags(NamedTuple):
    """A correlation against the lag, `(lags,)` each; NaN where unknown."""

    lags: np.ndarray  # s
    values: np.ndarray
    bounds: np.ndarray


class Sailed(NamedTuple):
    """The seconds in each bin of a command or of the speed."""

    edges: np.ndarray  # (bins + 1,)
    seconds: np.ndarray  # (bins,)


class Diagnostics(NamedTuple):
    """As of `usvlearn.model.fit.diagnostics`."""

    missions: Sequence[Mission]
    worst: Sequence[Course]
    autocorrelation: Lags
    cross_correlation: Mapping[str, Lags]  # of PUSHES
    curves: Mapping[str, Curve]  # thrust_left, thrust_right, drag
    sailed: Mapping[str, Sailed]  # left, right, speed


class SavedFit(NamedTuple):
    """The fit of one boat."""

    terms: str
    missions: int
    mass: float  # kg
    quantities: Mapping[str, Quantity]
    lacks: Sequence[str]  # what the logs lack, one sentence each
    sets: Mapping[str, SetOfTerms]
    simulation: str  # which open-loop simulation to use, a sentence; "" where that was not compared
    diagnostics: Diagnostics
    doubts: Sequence[str]  # what speaks against the use of its values


def saved_fits(folders: Sequence[Path], boats: Sequence[str]) -> dict[str, SavedFit | str]:
    """The fit of each boat that has one, of the last run in which it is; a sentence in place of a damaged one."""
    fits: dict[str, SavedFit | str] = {}
    for boat in boats:
        paths = [folder / FOLDER / f"{boat}{ENDING}" for folder in folders]
        if path := next((each for each in reversed(paths) if each.is_file()), None):
            try:
                fits[boat] = read_fit(path)
            except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
                what = f"it has no {error}" if isinstance(error, KeyError) else printable(f"{error}" or "too deep")
                fits[boat] = (
                    f"{FOLDER}/{path.name}: is damaged ({what:.120}): run usvlearn fit {path.parents[1]} again."
                )
    return fits


def read_fit(path: Path) -> SavedFit:
    """One file; any exception of reading or of its content if it is damaged."""
    if path.stat().st_size > LARGEST:
        raise ValueError(f"found more than {LARGEST // 10**6} MB")
    facts = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refused)
    quantities = {}
    for name, each in facts["quantities"].items():
        if unit := (QUANTITIES | TURNING | OF_FIT).get(name):
            value, low, high = (_number(each[key], True) for key in ("value", "low", "high"))
            quantities[name] = Quantity(value, low, high, unit)
    if not quantities:
        raise ValueError("it has no quantities")
    return SavedFit(
        _text(facts["terms"]),
        int(_number(facts["missions"])),
        _number(facts["mass"]),
        quantities,
        [_text(each) for each in _some(facts["lacks"], FEW)],
        {
            _text(name): SetOfTerms(*(_number(each.get(key), True) for key in SetOfTerms._fields))
            for name, each in list(facts["sets"].items())[:FEW]
        },
        _text(facts["simulation"]["sentence"]) if facts.get("simulation") is not None else "",
        _diagnostics(facts["diagnostics"]),
        [_text(each) for each in _some(facts["doubts"], FEW)],
    )


def _diagnostics(facts: Mapping[str, Any]) -> Diagnostics:
    cross, curves, sailed = (facts[key] for key in ("cross_correlation", "curves", "sailed"))
    return Diagnostics(
        [_mission(each) for each in _some(facts["missions"])],
        [
            Course(_text(each["name"]), _number(each["start"]), *_columns(each, Course._fields[2:]))
            for each in _some(facts["worst"], FEW)
        ],
        _lags(facts["autocorrelation"]),
        {name: _lags(cross[name]) for name in PUSHES},
        {name: _curve(curves[name]) for name in ("drag", *(f"thrust_{side}" for side in SIDES))},
        {name: _sailed(sailed[name]) for name in (*SIDES, "speed")},
    )


def _mission(each: Mapping[str, Any]) -> Mission:
    worst, current = each["worst"] or {"start": None, "mae": None}, each["current"]
    steps, minutes, mae, fit, bias = (_number(each[key], True) for key in Mission._fields[1:6])
    size = math.nan if current is None else float(np.linalg.norm([_number(x) for x in _some(current)]))
    start, error = _number(worst["start"], True), _number(worst["mae"], True)
    return Mission(_text(each["name"]), steps, minutes, mae, fit, bias, size, start, error)


def _lags(each: Mapping[str, Any]) -> Lags:
    lags = Lags(*_columns(each, Lags._fields))
    if not np.isfinite(lags.lags).all() or not (np.diff(lags.lags) > 0).all() or (lags.bounds < 0).any():
        raise ValueError("a correlation is none")
    return lags


def _curve(each: Mapping[str, Any]) -> Curve:
    curve = Curve(*_columns(each, Curve._fields))
    if len(curve.at) < 2 or not all(np.isfinite(x).all() for x in curve) or not (np.diff(curve.at) > 0).all():
        raise ValueError("a curve is no curve")
    return curve


def _sailed(each: Mapping[str, Any]) -> Sailed:
    sailed = Sailed(_numbers(each["edges"]), _numbers(each["seconds"]))
    if len(sailed.edges) != len(sailed.seconds) + 1 or len(sailed.edges) < 2 or not (np.diff(sailed.edges) > 0).all():
        raise ValueError("a histogram is none")
    if not (sailed.seconds >= 0).all():
        raise ValueError("a histogram has no negative seconds")
    return sailed


def _columns(each: Mapping[str, Any], names: Sequence[str]) -> list[np.ndarray]:
    """Lists of equal lengths."""
    columns = [_numbers(each[name]) for name in names]
    if len({len(x) for x in columns}) != 1 or not len(columns[0]):
        raise ValueError(f"{', '.join(names)} are no columns of a table")
    return columns


def _numbers(x: Any) -> np.ndarray:
    """NaN for None."""
    return np.array([_number(each, True) for each in _some(x)], float)


def _some(x: Any, most: int = LONGEST) -> list[Any]:
    if not isinstance(x, list) or len(x) > most:
        raise ValueError(f"found {_head(x)}, expected a list of at most {most}")
    return x


def _number(x: Any, unknown: bool = False) -> float:
    """A number; with `unknown`, NaN for None."""
    if x is None and unknown:
        return math.nan
    if isinstance(x, bool) or not isinstance(x, int | float) or not abs(x) < ABSURD:
        raise ValueError(f"found {_head(x)}, expected a number below {ABSURD:g}")
    return float(x)


def _text(x: Any) -> str:
    if not isinstance(x, str) or len(x) > LETTERS:
        raise ValueError(f"found {_head(x)}, expected a text of at most {LETTERS} letters")
    return printable(x)


def _head(x: Any) -> str:
    """The beginning of what was found; a list is not written out."""
    return f"{type(x).__name__} of {len(x)}" if isinstance(x, list | dict) else printable(repr(x)[:40])


def _refused(name: str) -> float:
    raise ValueError(f"found {name}, which JSON does not have")
