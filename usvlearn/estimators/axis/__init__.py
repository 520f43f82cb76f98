"""The axis EKF: yaw rate or sway, with the parameters of its dynamics."""
