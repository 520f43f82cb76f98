"""What shows numbers to a person: colours of figures, tables in a terminal, files of TensorBoard."""
