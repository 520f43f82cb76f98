"""The formats of logs: a parser each, with one interface."""
