"""Writes all TensorBoard files; the list of tags.

    online/mae/BOAT/ESTIMATOR      m/s, over the last minutes
    online/skill/BOAT/ESTIMATOR    1 - MAE/MAE(persistence), over the same steps
    state/BOAT/ESTIMATOR/NUMBER    from `Estimator.monitor`: physical parameters by name, excitation_PARAMETER (0:
                                   a guess, 1: informed), least_informed_PARAMETER (the direction about which the data
                                   contain least), covariance_trace, deviation in m/s, weight_MEMBER; of a robust
                                   estimator clipped, rejected and escaped samples, scale in m/s; of an RNN
                                   margin_CONDITION (> 0: contracting), contraction_rate, time_constant in s, and at
                                   rest the number of equilibria, the nearest, m/s, and its class, counted from 0
                                   in the order of certify.equilibria.CLASSES
    rejected/BOAT/CHANNEL/CAUSE    counts over the whole log
    state/BOAT/monitors/NUMBER     whiteness_ESTIMATOR (lag 1; white within ± whiteness_band), scale_ESTIMATOR in m/s;
                                   effectiveness_SIDE and evidence_SIDE of a lost thruster, alarm (0 or 1), alarms
    identified/BOAT/QUANTITY/…     value, and low and high of its 90 % interval (`usvlearn.identified`)
    prediction/BOAT, thrusters/BOAT  figures; the latter of the run in which an alarm was raised
    total/mae/ESTIMATOR            m/s, whole run, mean over boats; compared on the HPARAMS page
    report/FIGURE, report/SECTION  of a report: its figures; its findings and tables, as text
    learn/loss, learn/PATH         of learning by gradient: MAE of a window, m/s, and the hyperparameters

The runs of a tuning are named after its best settings, such as `gain=3.16`.

The horizontal axis counts the steps of the grid. The CUSTOM SCALARS page draws all estimators in one chart.
"""

from __future__ import annotations

import functools
import io
import threading
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


class TensorBoardWriter:
    """A TensorBoard run in a folder.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, TensorBoardWriter(folder) as board:
    ...     board.scalars("online/mae/heron", {"aid": 0.05}, step=750)
    """

    def __init__(self, folder: str | Path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of TensorBoard's own imports
            from torch.utils.tensorboard import SummaryWriter
        _speed_up()
        before: Callable[[Any], object] = threading.excepthook
        threading.excepthook = functools.partial(_unless_tensorboard, before)
        try:
            self._writer: Any = SummaryWriter(str(folder), max_queue=1000, flush_secs=30)
        except BaseException:
            _restore_excepthook()
            raise

    def scalars(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Write one point of each curve `prefix/name` in one record; a record for each would take ten times as long."""
        record, places = _template(prefix, tuple(values))
        with np.errstate(over="ignore"):  # beyond float32 it is infinite
            record[places] = (
                np.fromiter(values.values(), float, len(values)).astype("<f4").view(np.uint8).reshape(-1, 4)
            )
        self._writer.file_writer.add_summary(_summary().FromString(record.tobytes()), step)

    def charts(self, pages: Mapping[str, Mapping[str, list[str]]]) -> None:
        """Set which curves the CUSTOM SCALARS page draws together: page -> chart -> tags."""
        layout = {
            page: {chart: ["Multiline", [f"^{tag}$" for tag in tags]] for chart, tags in charts.items()}
            for page, charts in pages.items()
        }
        self._writer.add_custom_scalars(layout)

    def figure(self, tag: str, figure, step: int) -> None:
        """Write a matplotlib figure."""
        png = io.BytesIO()
        figure.savefig(png, format="png", pil_kwargs={"compress_level": 1})  # add_figure imports pyplot for that
        self.image(tag, png.getvalue(), step)

    def image(self, tag: str, png: bytes, step: int = 0) -> None:
        """Write a picture, given as PNG."""
        Summary = _summary()
        width, height = (int.from_bytes(png[at : at + 4]) for at in (16, 20))  # the header has a fixed place
        image = Summary.Image(width=width, height=height, colorspace=4, encoded_image_string=png)
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def text(self, tag: str, markdown: str) -> None:
        """Write a text for the TEXT page."""
        self._writer.add_text(tag, markdown)

    def hparams(self, settings: Mapping[str, object], results: Mapping[str, float], run: str = ".") -> None:
        """Write the record by which the HPARAMS page compares runs; names with a leading _ are left out.

        Args:
            settings: nested by key.
            results: by tag.
            run: a name for this record, if one folder contains the records of several runs.
        """
        flat = dict(_flatten(settings))
        self._writer.add_hparams(flat, dict(results), run_name=run)

    def close(self) -> None:
        try:
            self._writer.close()
        finally:
            _restore_excepthook()

    def __enter__(self) -> TensorBoardWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _summary() -> Any:
    """The class of TensorBoard's records."""
    from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]  # generated

    return Summary


def _speed_up() -> None:
    """Let TensorBoard compute its checksums in compiled code, if numba is installed and enabled."""
    from tensorboard.summary.writer import record_writer

    try:
        from usvlearn.crc import masked_crc32c
        from usvlearn.jit import NUMBA
    except ImportError:
        return
    if hasattr(record_writer, "masked_crc32c") and not NUMBA.DISABLE_JIT:
        masked_crc32c(b"")  # compiles
        record_writer.masked_crc32c = masked_crc32c


@functools.lru_cache(maxsize=1024)
def _template(prefix: str, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The bytes of a record of points, and the places of their values in it, `(names, 4)`.

    Filling these in takes a tenth of the time of making an object for each point.
    """
    Summary = _summary()
    points = [Summary(value=[Summary.Value(tag=f"{prefix}/{name}", simple_value=1.0)]) for name in names]
    parts = [point.SerializeToString() for point in points]  # each ends with its value
    ends = np.cumsum([len(part) for part in parts], dtype=int)
    return np.frombuffer(b"".join(parts), np.uint8).copy(), ends[:, None] + np.arange(-4, 0)


def _unless_tensorboard(before: Callable[[Any], object], failed: Any) -> None:
    """Report no errors of TensorBoard's thread, such as a full disk: the next write raises them again."""
    if not type(failed.thread).__module__.startswith("tensorboard"):
        before(failed)


def _restore_excepthook() -> None:
    hook = threading.excepthook
    if isinstance(hook, functools.partial) and hook.func is _unless_tensorboard:
        threading.excepthook = hook.args[0]


def _flatten(tree: Mapping, prefix: str = ""):
    for key, value in tree.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        if str(key).startswith("_"):
            continue
        if isinstance(value, Mapping):
            yield from _flatten(value, name)
        elif isinstance(value, bool | int | float | str):
            yield name, value
        elif value is not None:
            yield name, str(value)
