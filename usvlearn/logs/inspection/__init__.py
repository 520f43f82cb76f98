"""What a log holds, which channels it has in which units, and the configuration that reads it. Imports no torch."""
