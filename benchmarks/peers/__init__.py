"""Other libraries' models of a boat: `online` ones learn step by step; batch ones are told all runs at once."""

from peers.online import LAM, NOISE, P, Peer, peers, plain_rls

__all__ = ["LAM", "NOISE", "P", "Peer", "peers", "plain_rls"]
