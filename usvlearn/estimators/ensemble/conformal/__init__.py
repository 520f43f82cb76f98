"""Prediction intervals that adapt."""
