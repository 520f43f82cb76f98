"""The ARX filter."""
