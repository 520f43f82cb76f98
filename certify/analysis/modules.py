"""Certifies a module of torch in memory: the work of `certify.certify`."""

from __future__ import annotations

from typing import Any, NamedTuple

from certify.analysis.assess import assess, judged
from certify.errors import CertifyError, quoted
from certify.networks.recurrent import of_torch
from certify.networks.shallow import arrays_of
from certify.networks.vector import activation, from_tensors

TORCH = "torch.nn.modules.rnn"


class Certified(NamedTuple):
    """The verdict on one recurrent network."""

    contracting: bool  # proved; False says only that no proof was found
    condition: str | None  # by which it is proved: exact or quadratic
    rate: float | None  # the smallest one that is proved, per step, rounded up; None where none is below 1
    certificate: dict[str, Any] | None  # for `certify.proofs.certificate.write`
    found: dict[str, Any]  # all else that `certify.analysis.assess.assess` finds


def judge(module: Any, nonlinearity: str | None, seconds: float, full: bool) -> Certified:
    """See `certify.certify`."""
    kind = type(module).__name__
    if not hasattr(module, "state_dict"):
        raise CertifyError(f"module: found {quoted(kind)}, expected a torch.nn.RNN, an RNNCell or a module with one")
    tensors = arrays_of(module.state_dict(), kind)
    networks = of_torch(tensors, kind)
    if len(networks) != 1:
        raise CertifyError(f"{kind}: found {len(networks)} networks of torch.nn.RNN or RNNCell in it, expected one")
    rnn = module.get_submodule(networks[0].prefix)
    if not {f"{each.__module__}.{each.__name__}" for each in type(rnn).__mro__} & {f"{TORCH}.RNN", f"{TORCH}.RNNCell"}:
        raise CertifyError(f"{kind}: found {type(rnn).__name__}, expected a torch.nn.RNN or RNNCell")
    stated = getattr(rnn, "nonlinearity", nonlinearity)
    if stated is None or nonlinearity not in (None, stated):
        raise CertifyError(
            f"nonlinearity: found {quoted(nonlinearity)}, and the module has {quoted(stated)}: give the module's"
        )
    (network,) = from_tensors(tensors, kind, activation(stated))
    row, certificates = assess(network._replace(path=""), seconds=seconds, solver="" if full else None)
    condition = judged(row, certificates, None)
    return Certified(condition is not None, condition, row["rate"], certificates.get(condition or ""), row)
