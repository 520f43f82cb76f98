"""Contraction certificates for shallow ReLU recurrent networks. Never imports usvlearn."""
