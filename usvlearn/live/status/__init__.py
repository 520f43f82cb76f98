"""What a node tells people: its status, the page of an operator, and what it publishes."""
