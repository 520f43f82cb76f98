"""The base of all packages: samples, the protocol of an estimator, families, compiled code, checkpoints, the lock."""
