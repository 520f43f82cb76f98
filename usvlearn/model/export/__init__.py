"""Writes what was learned in the formats of other programs. Imports no torch."""
