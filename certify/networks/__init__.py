"""The networks that are judged: their weights, as files and in memory."""
