"""Models of other libraries: `online` ones learn step by step; batch ones are fitted to all runs at once."""

from peers.online import LAM, NOISE, P, Peer, peers, plain_rls

__all__ = ["LAM", "NOISE", "P", "Peer", "peers", "plain_rls"]
