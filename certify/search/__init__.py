"""What finds a proof: floating point and solvers. It may be wrong; `proofs` decides."""
