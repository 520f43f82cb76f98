"""Fault accommodation: what the monitor of the thrusters finds is given to the filters."""
