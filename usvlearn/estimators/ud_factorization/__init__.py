"""The covariance of a Kalman filter in factors, P = U D Uᵀ (Bierman 1977): `layer` in torch, `kernel` compiled.

U is unit upper triangular and D diagonal. The leaf `factor` of a state, `(*batch, n, n)`, holds both, a column of U in
each row: U_ij at [j, i] for i < j, D_j at [j, j], zeros elsewhere.

An addition c a aᵀ, c ≥ 0, takes the columns from the last to the first (Agee & Turner 1972):

    d = D_j,  D_j = d + c a_j²,  κ = d/D_j,  β = c a_j/D_j,  c ← c κ
    U_ij ← U_ij κ + β a_i (as it was),  a_i ← a_i − a_j U_ij (as it was)                                 (1)

A measurement of Hᵀx with noise of variance α_0 takes them from the first. With f = UᵀH and G = D f:

    α_j = α_{j−1} + f_j G_j,   D_j ← D_j α_{j−1}/α_j,   U_ij ← U_ij − (f_j/α_{j−1}) Σ_{i≤l<j} U_il G_l         (2)

P H = U G is the last of these sums, and the last α the variance of the innovation. Neither subtracts from D, which so
stays positive, in float32 too. Where dᵀx > 0 must not be, the nearest x with dᵀx = 0 in the metric P⁻¹ is

    x − P d dᵀx/(dᵀP d)                                                                                  (3)

The derivation is in `docs/theory/estimators.md#factored-covariance`.
"""
