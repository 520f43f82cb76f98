"""Forecasts of an ensemble seconds ahead: weights and intervals for each horizon."""
