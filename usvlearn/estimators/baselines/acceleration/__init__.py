"""Constant acceleration: the next increment is the last one."""
