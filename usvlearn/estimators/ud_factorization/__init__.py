"""The covariance of a Kalman filter in factors, P = U D Uᵀ.

U is unit upper triangular and D diagonal. The leaf `factor` of a state, `(*batch, n, n)`, holds both, a column of U in
each row: U_ij at [j, i] for i < j, D_j at [j, j], zeros elsewhere. Equations (1) to (3) and their sources:
`docs/theory/estimators.md#factored-covariance`.
"""
