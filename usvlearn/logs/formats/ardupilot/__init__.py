"""ArduPilot: .bin, and MAVLink telemetry: .tlog."""
