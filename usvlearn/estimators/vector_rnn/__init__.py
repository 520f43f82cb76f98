"""The recurrent network of surge, sway and yaw rate."""
