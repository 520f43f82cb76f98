"""Persistence: the next speed is the last one."""
