"""Sweeps: jobs, launchers, the leaderboard."""
