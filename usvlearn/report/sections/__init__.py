"""The sections of a report, one file each: numbers, a figure, tables, what the paper found and what was found here."""
