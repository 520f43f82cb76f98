"""Proofs of contraction for recurrent networks. See docs/certification.md for what a verdict rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.analysis.modules import Certified


def certify(module: Any, nonlinearity: str | None = None, seconds: float = 10.0, full: bool = False) -> Certified:
    """Whether a torch.nn.RNN or RNNCell, or a module with one inside, contracts; proved in exact arithmetic.

    Args:
        module: of torch, its weights of any real type.
        nonlinearity: relu or tanh; by default what the module states.
        seconds: s, of the searches; a full metric of up to 64 states may take six times as long.
        full: search a full metric also where a diagonal one certifies: its rate may be smaller.

    Returns:
        The verdict, the smallest rate that is proved, and its certificate.

    Raises:
        CertifyError: another kind of module, several RNNs, another nonlinearity than the module's, or damaged weights.

    >>> import torch
    >>> _ = torch.manual_seed(0)
    >>> rnn = certify(torch.nn.RNN(input_size=4, hidden_size=8, nonlinearity="relu"))
    >>> rnn.contracting, round(rnn.rate, 2)
    (True, 0.98)
    """
    from certify.analysis.modules import judge

    return judge(module, nonlinearity, seconds, full)
