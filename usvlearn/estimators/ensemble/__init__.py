"""The ensemble: its combiners, its intervals, its monitors."""
