"""The ensemble: its rules, its intervals, its monitors."""
