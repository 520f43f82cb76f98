"""Writes TensorBoard files. A folder holds several TensorBoard runs, so that each curve has a colour and a switch.

A run folder's are BOAT/ESTIMATOR, BOAT/identified, identified low, identified high and truth, fleet/ESTIMATOR for means
over boats, and `results` with the texts and the row of the HPARAMS page. `usvlearn.runs.tensorboard` lists the tags. If
the run differs from the default, all are in a folder that is named after what differs, such as `rnn.neurons=20`.

A step is a second of run time of the boat: the time in the present run, and the lengths of those before. A run that is
resumed into another folder has its curves from there on only.

TensorBoard gives its seven colours to runs by the times of their first events, which are therefore written at once, in
a fixed order. A resumed run goes on in further files of the same runs. These begin with a mark by which TensorBoard
drops the points that were written after the place of the resume.
"""

from __future__ import annotations

import functools
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.display.figures import rendered

EVENTS = "events.out.tfevents"  # in the name of each file
LONGEST = 120  # characters of a folder's name
Setting = bool | float | str


class TensorBoardWriter:
    """TensorBoard runs in the folders below one, coloured in their order. Each has a thread, which writes what comes at
    once.

    From the step in `resumed` on, points of earlier files of a run are no longer valid. `about` has descriptions by
    tag.
    """

    def __init__(
        self,
        folder: str | Path,
        runs: Iterable[str] = (),
        resumed: Mapping[str, int] | None = None,
        about: Callable[[str], str] | None = None,
    ):
        self.folder, self._about, self._resumed = Path(folder), about or (lambda _: ""), resumed or {}
        self._files, self._told, self._began = dict[str, Any](), set[tuple[str, str]](), time.time()
        for run in runs:
            self._file(run)

    def scalars(self, values: Mapping[str, float], step: int, run: str = ".") -> None:
        """Write a point of each of some tags; the first point of a tag has its description."""
        points = []
        for tag, value in values.items():
            with np.errstate(over="ignore"):  # beyond float32 it is infinite
                point = _protos().Summary.Value(tag=tag, simple_value=float(np.float32(value)))
            if (run, tag) not in self._told:
                self._told.add((run, tag))
                point.metadata.summary_description = self._about(tag)
                point.metadata.plugin_data.plugin_name = "scalars"
            points.append(point)
        self._write(points, step, run)

    def figure(self, tag: str, figure: Any, step: int, run: str = ".") -> None:
        """Write a matplotlib figure."""
        self.image(tag, rendered(figure, pil_kwargs={"compress_level": 1}), step, run)

    def image(self, tag: str, png: bytes, step: int = 0, run: str = ".") -> None:
        """Write a picture, given as PNG."""
        protos = _protos()
        width, height = (int.from_bytes(png[at : at + 4]) for at in (16, 20))  # the header has a fixed place
        image = protos.Summary.Image(width=width, height=height, colorspace=4, encoded_image_string=png)
        self._write([protos.Summary.Value(tag=tag, image=image)], step, run)

    def text(self, tag: str, markdown: str, step: int = 0, run: str = ".") -> None:
        """Write a text for the TEXT page."""
        value = _protos().Summary.Value(tag=tag)
        value.metadata.plugin_data.plugin_name = "text"
        value.tensor.dtype = 7  # DT_STRING
        value.tensor.string_val.append(markdown.encode())
        self._write([value], step, run)

    def session(
        self, settings: Mapping[str, Setting], run: str = ".", seconds: float | None = None, failed: bool = False
    ) -> None:
        """Write a row of the HPARAMS page; its results are the first scalars of the same run."""
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
        """Write which settings and results (tag -> title) the HPARAMS page shows, in this order."""
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
        """Wait until everything is in the files."""
        for file in self._files.values():
            file.flush()

    def close(self) -> None:
        self.flush()
        for file in self._files.values():
            file.close()
        self._files.clear()

    def __enter__(self) -> TensorBoardWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _file(self, run: str) -> Any:
        """The writer of a run; it begins later than those before."""
        if run not in self._files:
            self._files[run] = _protos().EventFileWriter(str(self.folder / run), max_queue_size=0)
            if run in self._resumed:
                self._event(run, self._resumed[run], session_log={"status": 1})  # START
        return self._files[run]

    def _hparams(self, name: str, content: Any, run: str) -> None:
        value = _protos().Summary.Value(tag=f"_hparams_/{name}")
        value.metadata.plugin_data.plugin_name = "hparams"
        value.metadata.plugin_data.content = content.SerializeToString()
        value.tensor.dtype = 1  # DT_FLOAT
        value.tensor.tensor_shape.dim.add(size=0)
        self._write([value], 0, run)

    def _write(self, values: Sequence[Any], step: int, run: str) -> None:
        self._event(run, step, summary=_protos().Summary(value=values))

    def _event(self, run: str, step: int, **content: Any) -> None:
        self._file(run).add_event(_protos().Event(wall_time=time.time(), step=step, **content))


class _Protos:
    """What is used of TensorBoard."""

    def __init__(self):
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # generated
        from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboard.summary.writer.event_file_writer import EventFileWriter, _AsyncWriterThread

        self.Event, self.Summary, self.EventFileWriter = Event, Summary, EventFileWriter
        before = threading.excepthook

        def hook(error: threading.ExceptHookArgs) -> None:
            """The next call of a writer raises its thread's error, which need not be printed, too."""
            if not isinstance(error.thread, _AsyncWriterThread):
                before(error)

        threading.excepthook = hook


_protos = functools.cache(_Protos)


def folder_name(text: str) -> str:
    """A text as a name of a folder, and of one part of a run's name."""
    return re.sub(r"[^\w.,=+ -]+", "_", text).strip(" .")[:LONGEST].strip(" .") or "_"


def folder_names(texts: Iterable[str]) -> list[str]:
    """Texts as different names of folders."""
    names: list[str] = []
    for text in texts:
        name = folder_name(text)
        while name in names:
            name += "_"
        names.append(name)
    return names


def _hparams_protos() -> tuple[Any, Any]:
    """The generated classes of the HPARAMS page. TensorBoard's functions that make them need TensorFlow."""
    from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2

    return api_pb2, plugin_data_pb2
