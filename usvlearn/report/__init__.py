"""Reports: the page, its sections and figures, tables for the terminal, the study."""
