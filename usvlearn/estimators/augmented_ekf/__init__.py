"""Steps that extended Kalman filters with parameters in their state share: the joint EKF and the axis EKF."""
