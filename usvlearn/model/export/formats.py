"""The formats of `usvlearn export`: which files each one writes of a boat."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.display.json_values import finite
from usvlearn.model.export.c_header import c_header, identifier, planar_c_header
from usvlearn.model.export.casadi_text import casadi_text, planar_casadi_text
from usvlearn.model.export.described import described, planar_described
from usvlearn.model.export.onnx_network import onnx_networks
from usvlearn.model.export.planar_boat import PlanarBoat
from usvlearn.model.export.predictions import csv_table, mcap_file, stretches
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
        cells = np.empty(len(given), object)
        cells[:] = [_value(each) for each in given]
        return cells
    if given is None:
        return np.nan
    return np.asarray(given, np.float64 if _numeric(given) else object)


def _numeric(given: Any) -> bool:
    return isinstance(given, int | float | list)


def _name(key: str) -> str:
    """A key as the name of a field."""
    word = re.sub(r"\W", "_", key, flags=re.ASCII)[:LONGEST]
    return word if re.match(r"[A-Za-z]", word) else f"x{word}"[:LONGEST]


Files = dict[str, bytes]  # by the end of their names: all begin with the name of the boat


class Format(NamedTuple):
    """A format."""

    files: Callable[[IdentifiedBoat, Path], Files]  # of a boat and the folder of its run
    what: str  # for whom, one phrase
    planar: Callable[[PlanarBoat], Files] | None = None  # of the planar model, where it has that


def _json(document: Any) -> bytes:
    return (json.dumps(finite(document), indent=1) + "\n").encode()


FORMATS = {
    "json": Format(
        lambda boat, _: {".json": _json(described(boat))},
        "parameters, intervals, curves, signs, and the names of MSS and Gazebo",
        lambda planar: {"_planar.json": _json(planar_described(planar))},
    ),
    "c": Format(
        lambda boat, _: {"_surge.h": c_header(boat).encode()},
        "a C99 header with one function, the step",
        lambda planar: {"_planar.h": planar_c_header(planar).encode()},
    ),
    "casadi": Format(
        lambda boat, _: {"_casadi.py": casadi_text(boat).encode()},
        "the step as a function of CasADi, for MPC",
        lambda planar: {"_planar_casadi.py": planar_casadi_text(planar).encode()},
    ),
    "mat": Format(lambda boat, _: {".mat": mat_file(boat)}, "the content of json, for MATLAB, Octave and Simulink"),
    "csv": Format(
        lambda boat, folder: {".csv": csv_table(stretches(folder, boat.name))}, "predictions and inputs of every step"
    ),
    "mcap": Format(
        lambda boat, folder: {".mcap": mcap_file(boat.name, stretches(folder, boat.name))},
        "the same for Foxglove and PlotJuggler (extra export)",
    ),
    "onnx": Format(
        lambda boat, _: {f"_{name}.onnx": content for name, content in onnx_networks(boat).items()},
        "the recurrent network, one step (extra export)",
    ),
}


def file_name(boat: IdentifiedBoat, end: str) -> str:
    """The name of a boat's file; of a module and a header without characters that these cannot have."""
    return f"{identifier(boat.name) if end.endswith(('.py', '.h')) else boat.stem}{end}"
