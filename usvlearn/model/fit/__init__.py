"""The batch fit of an identified boat: the best parameters that its logs can give."""
