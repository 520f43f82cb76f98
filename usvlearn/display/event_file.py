"""Writes all TensorBoard files; the list of runs and tags.

RUN/tensorboard contains a TensorBoard run for each estimator of each boat, so that each has a colour and a switch:

    [WHAT DIFFERS/]BOAT/ESTIMATOR     [WHAT DIFFERS]: the settings of the command line, such as `rnn.neurons=20`
    …/BOAT/identified, identified low, identified high, truth     values, 90 % intervals, truth of simulated boats
    …/fleet/ESTIMATOR                 means over boats, where there are several
    …/results                         text, and the row of the HPARAMS page

A tag is the same for all boats and estimators. What concerns the boat is in the run of the ensemble's output:

    1 overview/…       over the last minutes: MAE, skill and share of measurements in the 90 % intervals, one step and
                       10 s ahead; alarms so far
    2 identified/…     quantities of `usvlearn.engine.identified`, with their units
    3 weights/…        of the ensemble and the other combiners, and of forecasts; the run is the member that is weighed
    4 contraction/…    of RNNs: margins by condition, rate, time constant, number of equilibria at rest, the nearest
    5 data/…           shares of steps with a measured speed and with stale inputs so far; rejected messages by cause
    6 diagnostics/…    whiteness and scale of errors, excitation, thrusters, what the estimators report about themselves
    7 figures/…        of a boat: predictions, open-loop simulation, forecast, identified curves, thrusters
    8 results/…        of the whole run, for the HPARAMS page
    9 all/…            with `log: all`: every number of every estimator, the nine parameters, all horizons;
                       equilibrium_class counts from 0 in the order of certify.proofs.equilibria.CLASSES
    run/…              text: settings, configuration, data, networks, the command that repeats the run

Other commands write `report/FIGURE` and `report/SECTION` of a report, and `learn/loss`, `learn/PATH` of learning by
gradient: MAE of a window, m/s, and the hyperparameters. The runs of a tuning are named after their settings.

A step is a second of run time of the boat: the time in the present run, and the lengths of those before. Figures stand
after the last one. A run that is resumed into another folder has its curves from there on only.

The page of a sweep, DIR/leaderboard, has a run for each job, with its row on HPARAMS and its learning curve, and
`failed jobs` as text. With several seeds, +mean RANK SETTING is the same of each setting. The
pages IMAGES and TEXT open with all runs unticked if there are more than 40: TOGGLE ALL RUNS.

TensorBoard gives its seven colours to runs by the times of their first events, which are therefore written in a fixed
order (`usvlearn.runs.tensorboard.board_tags`). A resumed run goes on in further files of the same runs. These begin
with a mark by which TensorBoard drops the points that were written after the place of the resume.
"""

from __future__ import annotations

import functools
import io
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.display.figures import rendered

EVENTS = "events.out.tfevents"  # in the name of each file
SECONDS, BYTES = 2.0, 2**22  # after which what is buffered is written
BEFORE = 1.0  # s, so that the first event of each run is its earliest
LONGEST = 120  # characters of a folder's name
Setting = bool | float | str


class TensorBoardWriter:
    """TensorBoard runs in the folders below one. What is written is buffered; there is no thread and no open file.

    Args:
        folder: of all the runs.
        runs: relative paths of runs, in the order in which TensorBoard gives them colours; others follow as they come.
        resumed: run -> the step from which on points of earlier files are no longer valid.
        about: tag -> description.

    Raises:
        OSError: also from any method: what is buffered could not be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, TensorBoardWriter(folder) as board:
    ...     board.scalars({"1 overview/MAE (m/s)": 0.05}, step=300, run="heron/aid")
    """

    def __init__(
        self,
        folder: str | Path,
        runs: Iterable[str] = (),
        resumed: Mapping[str, int] | None = None,
        about: Callable[[str], str] | None = None,
    ):
        _speed_up()
        self.folder, self._about = Path(folder), about or (lambda _: "")
        self._resumed, self._files = resumed or {}, dict[str, _EventFile]()
        self._began, self._flushed, self._buffered = time.time() - BEFORE, time.monotonic(), 0
        for run in runs:
            self._file(run)
        self.flush()

    def scalars(self, values: Mapping[str, float], step: int, run: str = ".") -> None:
        """Write a point of each of some tags in one record; a record for each would take ten times as long."""
        file, names = self._file(run), tuple(values)
        if file.known.issuperset(names):
            record, places = _template(names)
            with np.errstate(over="ignore"):  # beyond float32 it is infinite
                numbers = np.fromiter(values.values(), float, len(values)).astype("<f4")
            record[places] = numbers.view(np.uint8).reshape(-1, 4)
            self._summary(file, step, record.tobytes())
        else:  # the first point of a tag has its description
            Summary, points = _summary(), []
            for name, value in values.items():
                with np.errstate(over="ignore"):
                    point = Summary.Value(tag=name, simple_value=float(np.float32(value)))
                point.metadata.summary_description = self._about(name)
                point.metadata.plugin_data.plugin_name = "scalars"
                points.append(point)
            file.known.update(names)
            self._summary(file, step, Summary(value=points).SerializeToString())

    def figure(self, tag: str, figure, step: int, run: str = ".") -> None:
        """Write a matplotlib figure."""
        self.image(tag, rendered(figure, pil_kwargs={"compress_level": 1}), step, run)

    def image(self, tag: str, png: bytes, step: int = 0, run: str = ".") -> None:
        """Write a picture, given as PNG."""
        Summary = _summary()
        width, height = (int.from_bytes(png[at : at + 4]) for at in (16, 20))  # the header has a fixed place
        image = Summary.Image(width=width, height=height, colorspace=4, encoded_image_string=png)
        self._value(Summary.Value(tag=tag, image=image), step, run)

    def text(self, tag: str, markdown: str, step: int = 0, run: str = ".") -> None:
        """Write a text for the TEXT page."""
        value = _summary().Value(tag=tag)
        value.metadata.plugin_data.plugin_name = "text"
        value.tensor.dtype = 7  # DT_STRING
        value.tensor.string_val.append(markdown.encode())
        self._value(value, step, run)

    def session(
        self, settings: Mapping[str, Setting], run: str = ".", seconds: float | None = None, failed: bool = False
    ) -> None:
        """Write a row of the HPARAMS page; its results are the first scalars of the same run.

        Args:
            settings: by key.
            run: that the row names.
            seconds: that it took.
            failed: whether it has no results.
        """
        api, data = _hparams_protos()
        start = data.SessionStartInfo(start_time_secs=self._began)
        for key, value in settings.items():
            kind = {bool: "bool_value", str: "string_value"}.get(type(value), "number_value")
            setattr(start.hparams[key], kind, value)
        status = api.STATUS_FAILURE if failed else api.STATUS_SUCCESS
        end = data.SessionEndInfo(status=status, end_time_secs=self._began + (seconds or 0.0))
        self._hparams("session_start_info", data.HParamsPluginData(session_start_info=start), run)
        self._hparams("session_end_info", data.HParamsPluginData(session_end_info=end), run)

    def columns(self, settings: Mapping[str, Sequence[Setting]], results: Mapping[str, str]) -> None:
        """Write which settings and results the HPARAMS page shows, in this order; without it TensorBoard shows all.

        Args:
            settings: the values of each key.
            results: tag -> title.
        """
        api, data = _hparams_protos()
        experiment = api.Experiment(time_created_secs=self._began)
        for key, values in settings.items():
            text = any(isinstance(value, str) for value in values)
            kind = api.DATA_TYPE_STRING if text else api.DATA_TYPE_FLOAT64
            column = experiment.hparam_infos.add(name=key, type=kind, differs=True)
            short = ".".join(key.split(".")[-2:])
            column.display_name = short if [x.endswith(f".{short}") for x in settings].count(True) == 1 else key
            column.domain_discrete.extend(sorted({str(x) if text else float(x) for x in values}))
        for tag, title in results.items():
            experiment.metric_infos.add(name=api.MetricName(tag=tag), display_name=title)
        self._hparams("experiment", data.HParamsPluginData(experiment=experiment), ".")

    def flush(self) -> None:
        """Write what is buffered into the files."""
        self._flushed, self._buffered = time.monotonic(), 0
        for file in self._files.values():
            file.flush()

    def close(self) -> None:
        self.flush()

    def __enter__(self) -> TensorBoardWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _file(self, run: str) -> _EventFile:
        """The file of a run. It begins later than those before: TensorBoard sorts runs by the times of their first
        events, and gives them their colours in this order.
        """
        if run not in self._files:
            file = self._files[run] = _EventFile(self.folder / run)
            file.event(min(self._began + 1e-4 * len(self._files), time.time()), 0, file_version="brain.Event:2")
            if run in self._resumed:
                file.event(time.time(), self._resumed[run], session_log={"status": 1})  # START
        return self._files[run]

    def _hparams(self, name: str, content: Any, run: str) -> None:
        value = _summary().Value(tag=f"_hparams_/{name}")
        value.metadata.plugin_data.plugin_name = "hparams"
        value.metadata.plugin_data.content = content.SerializeToString()
        value.tensor.dtype = 1  # DT_FLOAT
        value.tensor.tensor_shape.dim.add(size=0)
        self._value(value, 0, run)

    def _value(self, value: Any, step: int, run: str) -> None:
        self._summary(self._file(run), step, _summary()(value=[value]).SerializeToString())

    def _summary(self, file: _EventFile, step: int, record: bytes) -> None:
        file.event(time.time(), step, record)
        self._buffered += len(record)
        if self._buffered > BYTES or time.monotonic() - self._flushed > SECONDS:
            self.flush()


class _EventFile:
    """A file of events, appended to when it is flushed. TensorBoard reads those of a run in order of their numbers."""

    def __init__(self, folder: Path):
        from tensorboard.summary.writer.record_writer import RecordWriter

        self.folder, self.path = folder, Path()
        self.known: set[str] = set()  # tags that have their description
        self._buffer = io.BytesIO()
        self._writer = RecordWriter(self._buffer)

    def event(self, wall_time: float, step: int, summary: bytes = b"", **more: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # generated

        head = Event(wall_time=wall_time, step=step, **more).SerializeToString()
        if summary:  # field 5, without another copy of its content
            head += b"\x2a" + _varint(len(summary)) + summary
        self._writer.write(head)

    def flush(self) -> None:
        content = self._buffer.getvalue()
        if not content:
            return
        self._buffer.seek(0)
        self._buffer.truncate()
        if not self.path.name:
            self.folder.mkdir(parents=True, exist_ok=True)
            numbers = (path.suffix[1:] for path in self.folder.glob(f"{EVENTS}.*"))
            number = 1 + max((int(each) for each in numbers if each.isdecimal()), default=0)
            self.path = self.folder / f"{EVENTS}.{number:010d}"
        with open(self.path, "ab") as file:
            file.write(content)


def folder_name(text: str) -> str:
    """A text as a name of a folder, and of one part of a run's name.

    >>> folder_name("data.path=../x aid.gain=3"), folder_name("..")
    ('data.path=.._x aid.gain=3', '_')
    """
    return re.sub(r"[^\w.,=+ -]+", "_", text).strip(" .")[:LONGEST].strip(" .") or "_"


def folder_names(texts: Iterable[str]) -> list[str]:
    """Texts as different names of folders.

    >>> folder_names(["a/b", "a:b", "c"])
    ['a_b', 'a_b_', 'c']
    """
    found: list[str] = []
    for text in texts:
        name = folder_name(text)
        while name in found:
            name += "_"
        found.append(name)
    return found


def _summary() -> Any:
    """The class of TensorBoard's records."""
    from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]  # generated

    return Summary


def _hparams_protos() -> tuple[Any, Any]:
    """The generated classes of the HPARAMS page. TensorBoard's functions that make them need TensorFlow."""
    from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2

    return api_pb2, plugin_data_pb2


def _speed_up() -> None:
    """Let TensorBoard compute its checksums in compiled code, if numba is installed."""
    from tensorboard.summary.writer import record_writer

    try:
        from usvlearn.display.event_crc import masked_crc32c
    except ImportError:
        return
    if hasattr(record_writer, "masked_crc32c"):
        masked_crc32c(b"")  # compiles
        record_writer.masked_crc32c = masked_crc32c


@functools.lru_cache(maxsize=4096)
def _template(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The bytes of a record of points, and the places of their values in it, `(names, 4)`.

    Filling these in takes a tenth of the time of making an object for each point.
    """
    Summary = _summary()
    points = [Summary(value=[Summary.Value(tag=name, simple_value=1.0)]) for name in names]
    parts = [point.SerializeToString() for point in points]  # each ends with its value
    ends = np.cumsum([len(part) for part in parts], dtype=int)
    return np.frombuffer(b"".join(parts), np.uint8).copy(), ends[:, None] + np.arange(-4, 0)


def _varint(number: int) -> bytes:
    """Protobuf's encoding of a whole number."""
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    found.append(number)
    return bytes(found)
