"""The commands `certify` and `certify compare`."""
