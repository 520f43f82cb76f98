"""The joint filter: speed, disturbance, current and parameters in one extended Kalman filter."""
