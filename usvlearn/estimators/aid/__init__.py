"""Adaptive identification."""
