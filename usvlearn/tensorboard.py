"""The only writer of TensorBoard files, and the list of tags.

    online/mae/BOAT/ESTIMATOR      m/s, over the last minutes
    online/skill/BOAT/ESTIMATOR    1 - MAE/MAE(persistence), likewise
    state/BOAT/ESTIMATOR/NUMBER    what `Estimator.monitor` shows: physical parameters by name, covariance_trace,
                                   margin_simple, margin_tight, weight_MEMBER
    rejected/BOAT/CHANNEL/CAUSE    counts over the whole log
    prediction/BOAT                a figure
    mae/ESTIMATOR                  m/s, mean over boats: what the HPARAMS page compares

The horizontal axis counts the steps of the grid; `hparams` makes one record a run.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path


class Board:
    """A TensorBoard run in a folder.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Board(folder) as board:
    ...     board.scalars("online/mae/heron", {"aid": 0.05}, step=750)
    """

    def __init__(self, folder: str | Path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of TensorBoard's own imports
            from torch.utils.tensorboard import SummaryWriter
        self._writer = SummaryWriter(str(folder), max_queue=1000, flush_secs=30)

    def scalars(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """One point of each curve `prefix/name`."""
        for name, value in values.items():
            self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def figure(self, tag: str, figure, step: int) -> None:
        """A matplotlib figure."""
        self._writer.add_figure(tag, figure, step)

    def hparams(self, settings: Mapping[str, object], results: Mapping[str, float]) -> None:
        """The one record by which TensorBoard's HPARAMS page compares runs."""
        flat = dict(_flatten(settings))
        self._writer.add_hparams(flat, dict(results), run_name=".")

    def close(self) -> None:
        self._writer.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _flatten(tree: Mapping, prefix: str = ""):
    for key, value in tree.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, Mapping):
            yield from _flatten(value, name)
        elif isinstance(value, bool | int | float | str):
            yield name, value
        elif value is not None:
            yield name, str(value)
