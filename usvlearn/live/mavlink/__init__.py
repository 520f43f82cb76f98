"""The node on a MAVLink link."""
