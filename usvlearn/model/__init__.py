"""The boat that a run has identified, as a model for use elsewhere. Imports no torch."""
