"""Interval widths as a function of the manoeuvre, for one step and for forecasts."""
