"""`python -m certify` for networks with a vector state: judged, written and printed beside the shallow ones."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from certify.analysis.vector_assess import STEPS, assess, best
from certify.errors import CertifyError, about
from certify.networks.vector import VectorNetwork
from certify.proofs import certificate, vector_certificate

SCALAR_ALONE = ("simple", "interval", "box")  # conditions of shallow networks alone


class Judged(NamedTuple):
    """The networks that could be judged."""

    networks: list[VectorNetwork]
    rows: list[dict[str, Any]]  # of `assess`, with the condition that was judged: `judged`, or None
    certificates: list[dict[str, Any] | None]  # of that condition
    steps: list[dict[str, Any] | None]  # of all steps
    failures: list[CertifyError]

    @property
    def held(self) -> list[bool]:
        return [each is not None for each in self.certificates]


def judge(options: argparse.Namespace, networks: Sequence[VectorNetwork]) -> Judged:
    """Assess every network by the options of the command.

    Raises:
        CertifyError: an option that is not for such networks.
    """
    if options.condition in SCALAR_ALONE:
        raise CertifyError(
            f"--condition: found {options.condition}, which is for networks with one state, and {networks[0].path} is "
            f"another kind: give one of {', '.join(vector_certificate.CONDITIONS)}"
        )
    alone = {"--headings": options.headings, "--input": options.input, "--box": options.box, "--plot": options.plot}
    if wrong := [name for name, value in alone.items() if value not in (None, False)]:
        raise CertifyError(f"{wrong[0]}: is for networks with one state, and {networks[0].path} is another kind")
    solver = options.solver.upper() if options.lmi or options.condition in ("lmi", "tight") else None
    judged = Judged([], [], [], [], [])
    for each in _shown(networks):
        try:
            with about(each.path):
                _refuse_condition(options.condition, each)
                row, made = assess(each, options.seconds, solver, options.steps)
        except CertifyError as error:  # the other networks are still judged
            judged.failures.append(error)
            continue
        name = best(made, options.condition)
        judged.networks.append(each)
        judged.rows.append({**row, "judged": name})
        judged.certificates.append(None if name is None else made[name])
        judged.steps.append(made.get(STEPS))
    return judged


def _refuse_condition(condition: str | None, network: VectorNetwork) -> None:
    """Raise where a condition is about other networks: "does not hold" would be misunderstood."""
    if condition in ("gershgorin", "lmi") and network.activation.name != "relu":
        raise CertifyError(f"--condition {condition}: is for relu, found {network.activation}: try exact or tight")
    if condition == "gershgorin" and network.weights.V is not None:
        raise CertifyError("--condition gershgorin: is for one hidden layer, found two: try exact or tight")


def _shown(networks: Sequence[VectorNetwork]) -> Iterable[VectorNetwork]:
    if len(networks) < 2:
        return networks
    from certify.display.printed import progress

    return progress(networks, "certifying")


def write_certificates(folder: Path, judged: Judged, names: Sequence[str]) -> int:
    """Write the certificate of each network that holds, and that of its steps; returns their number."""
    written = 0
    for row, made, all_steps, name in zip(judged.rows, judged.certificates, judged.steps, names, strict=True):
        for kind, content in ((row["judged"], made), (STEPS, all_steps)):
            if content is not None:
                certificate.write(folder / f"{name}.{kind}.json", content)
                written += 1
    return written
