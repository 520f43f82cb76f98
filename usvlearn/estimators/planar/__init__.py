"""Surge, sway and yaw rate side by side, and the tracks that they make."""
