"""MOOS: .alog."""
