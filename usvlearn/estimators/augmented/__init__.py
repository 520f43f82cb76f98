"""What extended Kalman filters whose state holds the parameters have in common: the joint EKF and the axis EKF."""
