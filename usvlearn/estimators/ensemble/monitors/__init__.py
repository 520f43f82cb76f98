"""Monitors of the innovations and of the thrusters."""
