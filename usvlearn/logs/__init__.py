"""Logs to samples: readers, channels, alignment. Imports no torch."""
