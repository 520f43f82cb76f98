"""The estimators: a family is a folder with `state.py` (torch-free), `layer.py` (torch) and `kernel.py` (numba)."""

# The families with a kernel, in the order in which compiled code asks which of them an estimator is of.
COMPILED = (
    "least_squares",
    "aid",
    "rnn",
    "joint",
    "baselines.persistence",
    "arx",
    "axis",
    "external",
)
