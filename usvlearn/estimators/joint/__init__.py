"""The joint EKF: speed, disturbance, current and parameters in one extended Kalman filter."""
