"""Parsers of log formats, all with one interface."""
