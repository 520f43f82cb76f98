"""Channels: where a quantity lies in a log, its unit, and quantities that follow from others."""
