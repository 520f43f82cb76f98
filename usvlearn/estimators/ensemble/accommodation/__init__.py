"""Fault accommodation: the filters use the losses that the monitor of the thrusters finds."""
