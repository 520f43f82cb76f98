"""What is printed and drawn of verdicts."""
