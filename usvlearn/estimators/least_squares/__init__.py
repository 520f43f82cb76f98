"""Recursive least squares."""
