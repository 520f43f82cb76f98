import os

os.environ.setdefault("NUMBA_ENABLE_CUDASIM", "1")  # numba simulates a GPU; it reads this when it is imported
