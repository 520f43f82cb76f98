"""PX4: .ulg."""
