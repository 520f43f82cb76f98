"""The checks of `usvlearn.logs.data_check`: each looks at one boat's evidence and yields findings."""
