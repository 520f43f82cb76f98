"""Memory: the step before, for a model that uses it."""
