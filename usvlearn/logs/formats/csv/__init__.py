"""Tables: CSV and its dialects."""
