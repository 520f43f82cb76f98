"""What wraps an estimator."""
