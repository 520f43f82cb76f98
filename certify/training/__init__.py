"""Closed forms and projections in torch, used while a network learns."""
