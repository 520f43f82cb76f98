"""Evaluation of predictions: errors, cross-validation, rankings."""
