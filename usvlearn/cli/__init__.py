"""The commands train and evaluate; the only package that uses Hydra and configs/."""
