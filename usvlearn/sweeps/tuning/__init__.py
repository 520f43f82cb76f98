"""Tuning of hyperparameters: by grid, by gradient, by Optuna."""
