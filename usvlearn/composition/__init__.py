"""From files and arguments to settings, estimators and checked logs: what the commands and `usvlearn.read` share."""
