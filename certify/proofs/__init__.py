"""Exact arithmetic in integers and fractions, on which every verdict rests."""
