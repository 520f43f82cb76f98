"""Members of an ensemble whose steps other code than this package's kernels makes."""
