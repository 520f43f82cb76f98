"""Alignment: messages of all channels become samples on one time base."""
