"""Proofs of contraction for recurrent networks. See docs/certification.md for what a verdict rests on."""
