"""A speed controller from an identified boat: feedforward, PI gains, margins, and its closed loop. Imports no torch."""
