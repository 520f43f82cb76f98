"""Judges the networks of `python -m certify` by the options of the command, and writes their certificates."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.analysis import assess
from certify.errors import CertifyError, about
from certify.networks.shallow import Network
from certify.networks.vector import MOST_STATES, VectorNetwork, is_recurrent
from certify.proofs import certificate, vector_certificate
from certify.search.box import box, operating_box

SCALAR_ALONE = ("simple", "interval", "box")  # conditions of networks with one state alone


class Judged(NamedTuple):
    """One network that could be judged."""

    network: Network | VectorNetwork
    row: dict[str, Any]  # of `assess`, and `judged`: the condition that certifies it, or None
    certificates: dict[str, dict[str, Any]]  # of a vector state


def judge(
    options: argparse.Namespace, networks: Sequence[Network | VectorNetwork]
) -> tuple[list[Judged], list[CertifyError]]:
    """Assess every network by the options of the command; and the errors about those that cannot be judged.

    A CertifyError about an option that is not for such networks, or whose value does not fit them.
    """
    boxes: dict[int, Any] = {}
    inputs: dict[int, np.ndarray] = {}
    for network in networks:  # report every bad argument before computing anything
        m = network.inputs
        if isinstance(network, VectorNetwork):
            _refuse_options(options, network)
            continue
        if options.box is not None and m not in boxes:
            try:
                boxes[m] = box(options.box, m) if options.box else operating_box(m)
            except CertifyError as error:
                raise CertifyError(f"{network.path}: {error}") from error
        if m not in inputs:
            inputs[m] = input_of(options.input, m, network.path)
    judged, failures = [], []
    for each in _shown(options, networks):
        try:
            with about(each.path):
                if isinstance(each, VectorNetwork):
                    _refuse_condition(options.condition, each)
                    solve = options.lmi or options.condition in ("lmi", "quadratic")
                    more: dict[str, Any] = {"solver": options.solver.upper() if solve else None, "steps": options.steps}
                else:
                    more = {"u": inputs[each.inputs], "box": boxes.get(each.inputs)}
                    more["solver"] = options.solver if options.lmi else None
                row, proved = assess.assess(each, seconds=options.seconds, **more)
        except CertifyError as error:  # the other networks are still judged
            failures.append(error)
            continue
        judged.append(Judged(each, {**row, "judged": assess.judged(row, proved, options.condition)}, proved))
    return judged, failures


def _refuse_options(options: argparse.Namespace, network: VectorNetwork) -> None:
    if options.condition in SCALAR_ALONE:
        raise CertifyError(
            f"--condition: found {options.condition}, which is for networks with one state, and {network.path} is "
            f"another kind: give one of {', '.join(vector_certificate.CONDITIONS)}"
        )
    if options.steps and network.states > MOST_STATES:
        raise CertifyError(f"--steps: is for at most {MOST_STATES} states, and {network.path} has {network.states}")
    alone = {"--headings": options.headings, "--input": options.input, "--box": options.box, "--plot": options.plot}
    if wrong := [name for name, value in alone.items() if value not in (None, False)]:
        raise CertifyError(f"{wrong[0]}: is for networks with one state, and {network.path} is another kind")


def _refuse_condition(condition: str | None, network: VectorNetwork) -> None:
    """Raise where a condition is about other networks: "does not hold" would be misunderstood."""
    if condition in ("gershgorin", "lmi") and is_recurrent(network.weights):
        raise CertifyError(f"--condition {condition}: is not for x⁺ = φ(W x + …): try exact or quadratic")
    if condition in ("gershgorin", "lmi") and network.activation.name != "relu":
        raise CertifyError(f"--condition {condition}: is for relu, found {network.activation}: try exact or quadratic")
    if condition == "gershgorin" and network.weights.V is not None:
        raise CertifyError("--condition gershgorin: is for one hidden layer, found two: try exact or quadratic")


def _shown(
    options: argparse.Namespace, networks: Sequence[Network | VectorNetwork]
) -> Iterable[Network | VectorNetwork]:
    slow = options.lmi or options.box is not None or any(isinstance(each, VectorNetwork) for each in networks)
    if len(networks) < 2 or not slow:
        return networks
    from certify.display.tables import progress

    return progress(networks, "certifying")


def input_of(text: str | None, m: int, path: str) -> np.ndarray:
    """The constant input of --input, `(m,)`."""
    if text is None:
        return np.zeros(m)
    try:
        u = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise CertifyError(f"--input: found {text!r}, expected numbers separated by commas") from None
    if u.shape != (m,) or not np.isfinite(u).all():
        raise CertifyError(f"--input: found {text!r}, expected {m} finite numbers, the inputs of {path}")
    return u


def write_certificates(folder: Path, judged: Sequence[Judged]) -> tuple[int, list[str]]:
    """Write a certificate of each network that is certified, and that of its steps; their number, and what was not."""
    written, too_long = 0, []
    for each, name in zip(judged, _names([each.network for each in judged]), strict=True):
        kinds = [each.row["judged"], *([assess.STEPS] if assess.STEPS in each.certificates else [])]
        for kind in (kind for kind in kinds if kind is not None):
            content = _certificate(each, kind)
            if content is None:
                too_long.append(each.network.path)
                continue
            certificate.write(folder / f"{name}.{kind}.json", content)
            written += 1
    return written, too_long


def _certificate(each: Judged, condition: str) -> dict[str, Any] | None:
    if isinstance(each.network, VectorNetwork):
        return each.certificates[condition]
    more: dict[str, Any] = {}
    if condition in ("interval", "box"):
        inside = each.row["box"]
        more = {"box": box(inside["intervals"], each.row["m"]), "invariance_tree": inside["invariance_tree"]}
        if condition == "box":
            more |= {"tree": inside["tree"], "rate": Fraction(inside["proved_rate"])}
    return certificate.make(each.network.weights, condition, path=each.network.path, **more)


def _names(networks: Sequence[Network | VectorNetwork]) -> list[str]:
    """A file name for each checkpoint: the part of its path that differs from the others."""
    paths = [os.path.abspath(network.path) for network in networks]
    shared = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = [re.sub(r"\.(safetensors|npz|pth?)(?=\W|$)", "", os.path.relpath(path, shared)) for path in paths]
    names = [re.sub(r"[^\w.-]+", "_", name).strip("_") for name in names]
    for k in range(len(names)):
        while names[k] in names[:k]:
            names[k] += "_"
    return names
