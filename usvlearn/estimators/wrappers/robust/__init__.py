"""Robustness: outliers are clipped, what is not finite is refused."""
