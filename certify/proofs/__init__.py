"""What a verdict rests on: exact arithmetic alone, integers and fractions."""
