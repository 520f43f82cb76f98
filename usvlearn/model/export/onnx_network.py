"""The recurrent networks of a boat as ONNX models of one step: (1) of `docs/theory/estimators.md#rnn` in m/s."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.model.read_boats import IdentifiedBoat

OPSET, IR = 17, 8  # old enough for every runtime of today
INPUTS = ("surge", "heading_sin", "heading_cos", "command_left", "command_right")


def onnx_networks(boat: IdentifiedBoat) -> dict[str, bytes]:
    """The files' contents by the name of the network; a ConfigError if no member is one.

    The inputs are `surge`, m/s, `heading_sin`, `heading_cos`, and `command_left` and `command_right`, shares of full
    scale, each `(N,)` in double precision; the output is `surge_next`, m/s, `(N,)`. In a chain of steps, the network in
    usvlearn limits the speed that it feeds back to ±2 v_max.
    """
    networks = {name: each for name, each in boat.members.items() if each is not None and each["kind"] == "rnn"}
    if not networks:
        raise ConfigError(
            f"{boat.path}: found no network among {', '.join(boat.members)}, expected a member that is an RNN: "
            "learn with the estimator rnn"
        )
    return {name or "rnn": _network(boat.leaves, f"members.{name}." if name else "", each, name or "rnn")
            for name, each in networks.items()}  # fmt: skip


def _network(leaves: Mapping[str, np.ndarray], prefix: str, description: Mapping[str, Any], name: str) -> bytes:
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError as error:
        raise MissingExtraError("onnx", "export", "writing ONNX") from error
    a, w1, W2, b = (np.asarray(leaves[f"{prefix}weights.{each}"], np.float64) for each in ("a", "w1", "W2", "b"))
    scale = float(description["numbers"]["scale"])
    if not all(np.isfinite(each).all() for each in (a, w1, W2, b)):
        raise ConfigError(f"found the network {name}, whose weights are not finite, expected one that has not diverged")
    weights = np.concatenate([scale * w1[None], W2.T[:2] / 2, W2.T[2:]])  # (inputs, neurons)
    constants = {"weights": weights, "bias": b + W2[:, :2].sum(1) / 2, "readout": a[:, None] / scale,
                 "last": np.array([1])}  # fmt: skip
    nodes = [
        *(helper.make_node("Unsqueeze", [each, "last"], [f"{each}_column"]) for each in INPUTS),
        helper.make_node("Concat", [f"{each}_column" for each in INPUTS], ["rows"], axis=1),
        helper.make_node("MatMul", ["rows", "weights"], ["driven"]),
        helper.make_node("Add", ["driven", "bias"], ["before"]),
        helper.make_node("Relu", ["before"], ["after"]),
        helper.make_node("MatMul", ["after", "readout"], ["column"]),
        helper.make_node("Squeeze", ["column", "last"], ["surge_next"]),
    ]
    given = [helper.make_tensor_value_info(each, TensorProto.DOUBLE, ["N"]) for each in INPUTS]
    taken = [helper.make_tensor_value_info("surge_next", TensorProto.DOUBLE, ["N"])]
    initial = [numpy_helper.from_array(value, key) for key, value in constants.items()]
    graph = helper.make_graph(nodes, f"usvlearn_{name}", given, taken, initial)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    checker.check_model(model)
    return bytes(model.SerializeToString())
