"""Colours of figures, tables in a terminal, files of TensorBoard."""
