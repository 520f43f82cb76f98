"""Many networks judged: checkpoints, runs, sweeps, and the counts of a comparison."""
