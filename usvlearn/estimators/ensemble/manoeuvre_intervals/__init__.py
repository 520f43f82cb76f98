"""Half-widths of intervals that know the manoeuvre, for one step and for forecasts."""
