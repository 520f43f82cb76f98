"""Wrappers around an estimator."""
