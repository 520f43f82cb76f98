"""Searches proofs by floating point and solvers. It may be wrong; `proofs` decides."""
