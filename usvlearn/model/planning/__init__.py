"""What to sail next: commands and headings that shrink the intervals of an identified boat most. Imports no torch."""
