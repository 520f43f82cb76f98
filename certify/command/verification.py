"""Checks each certificate against the checkpoint that it is about: `python -m certify --verify`.

Certificates and weights may come from anybody, so the number of checkpoints is limited before they are compared.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from certify.errors import CertifyError, about, quoted
from certify.networks.shallow import SUFFIXES, Network, digest, refuse_many
from certify.networks.vector import VectorNetwork, activation, of_shallow, read_both
from certify.networks.vector import digest as vector_digest
from certify.proofs import certificate, vector_certificate
from certify.proofs.certificate import Verification

MOST_NETWORKS = 10_000  # that are compared with a certificate, about 1 s
LONGEST_PATH = 4096  # characters of a path that a certificate names


class Results(NamedTuple):
    """What was found."""

    rows: list[dict[str, Any]]  # certificate, valid, reason
    problems: list[CertifyError]  # one for each certificate that could not be compared

    @property
    def lines(self) -> list[str]:
        """One for each row."""
        return [f"{row['certificate']}: {'valid' if row['valid'] else 'REFUSED'}: {row['reason']}" for row in self.rows]


class Networks:
    """Checkpoints, found by the sha256 of their weights."""

    def __init__(self, networks: Sequence[Network], vectors: Sequence[VectorNetwork]) -> None:
        if networks or vectors:
            refuse_many(len(networks) + len(vectors), MOST_NETWORKS, (networks or vectors)[0].path)
        self.networks, self.vectors = networks, vectors

    @cached_property
    def _shallow(self) -> dict[str, Network]:
        return {digest(each.weights): each for each in reversed(self.networks)}

    @cached_property
    def _alike(self) -> dict[str, VectorNetwork]:
        alike = [*self.vectors, *(VectorNetwork(each.path, of_shallow(each.weights)) for each in self.networks)]
        return {vector_digest(each.weights): each for each in reversed(alike)}

    def about(self, content: dict[str, Any]) -> Network | VectorNetwork | None:
        """The first one that a certificate is about; None where it is about others."""
        wanted = str(content.get("weights"))
        if content.get("format") != vector_certificate.FORMAT:
            return self._shallow.get(wanted)
        return self._alike.get(wanted)


def verify(
    paths: Sequence[str],
    networks: Sequence[Network] = (),
    vectors: Sequence[VectorNetwork] = (),
    phi: str | None = None,
) -> Results:
    """Check certificates against networks; without networks, against the files that they name.

    φ of the networks is as claimed by default; a CertifyError if it is unknown, or there are too many networks.
    """
    given = Networks(networks, vectors) if networks or vectors else None
    results, known = Results([], []), dict[Path, Networks]()
    for path in paths:
        try:
            with about(str(path)):
                content = certificate.read(path)
                network = _named(path, content, known) if given is None else given.about(content)
                checked = _verified(content, network, phi)
        except CertifyError as error:  # the other certificates are still checked
            results.problems.append(error)
            continue
        results.rows.append({"certificate": path, "valid": checked.valid, "reason": checked.reason})
    return results


def _verified(content: dict[str, Any], network: Network | VectorNetwork | None, phi: str | None) -> Verification:
    if network is None:
        return Verification(False, "it is about other weights than the given ones")
    if isinstance(network, VectorNetwork):
        claimed = activation(phi or str(content.get("activation")))
        return vector_certificate.verify(content, network._replace(activation=claimed))
    return certificate.verify(content, network.weights)


def _named(path: str, content: dict[str, Any], known: dict[Path, Networks]) -> Network | VectorNetwork | None:
    """The checkpoint that a certificate names: below the working folder, or beside the certificate."""
    named, seen = str(content.get("path", "")), False
    file = re.sub(r"(\[[\d,]*\])?$", "", named[:LONGEST_PATH])
    for place in (Path(file), Path(path).parent / file, Path(path).parent / Path(file).name):
        for candidate in (place, Path(str(place).rpartition(":")[0])):
            if candidate.suffix in SUFFIXES and _is_file(candidate):
                seen = True
                if candidate not in known:  # certificates of one folder often name the same file
                    known.clear()
                    known[candidate] = Networks(*read_both(candidate, most=MOST_NETWORKS))
                if (network := known[candidate].about(content)) is not None:
                    return network
    if seen:
        return None
    raise CertifyError(f"its weights, {quoted(named)}, were not found: give their path before --verify")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False
