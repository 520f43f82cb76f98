"""Hyperparameters: by grid, by gradient, by Optuna."""
