"""The checks of `usvlearn.logs.checks.data_check`: each looks at one boat's evidence and yields findings."""
