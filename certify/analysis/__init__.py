"""Many networks judged: sets, runs, sweeps, and the counts of a comparison."""
