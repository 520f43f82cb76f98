"""Conditions and projections in torch, for networks that learn."""
