"""What every room stands on: samples, the protocol of an estimator, families, compiled code, checkpoints, the lock."""
