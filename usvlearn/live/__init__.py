"""The node aboard: it listens, predicts, learns, warns and saves. Imports neither torch nor Hydra."""
