"""Members of an ensemble that have no kernel: their steps are made by other code."""
