"""Learning over recorded runs."""
