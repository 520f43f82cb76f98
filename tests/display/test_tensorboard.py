"""TensorBoard's files, read by TensorBoard."""

import time

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from tests.support.boards import boards, texts, values
from usvlearn.display.figures import colours
from usvlearn.display.json_values import finite
from usvlearn.display.tensorboard import TensorBoardWriter, folder_names
from usvlearn.evaluation.metrics import worst_minute


def test_texts_are_names_of_different_folders():
    names = ["data.path=../x aid.gain=3", "..", "a/b", "a:b", "c"]
    assert folder_names(names) == ["data.path=.._x aid.gain=3", "_", "a_b", "a_b_", "c"]


def test_an_estimator_has_one_colour_and_the_next_only_where_two_would_share_it():
    assert colours(["aid", "my_rls", "ensemble+"]) == {"aid": "#12b5cb", "my_rls": "#6699CC", "ensemble+": "#e52592"}
    assert colours(["mine", "my_rls"])["my_rls"] == "#6699CC"


def test_the_worst_minute_is_found_and_json_has_finite_numbers():
    assert worst_minute(np.arange(200.0), np.where(np.arange(200) == 100, 1.0, 0.0)) == (41, 101)
    assert finite({"a": np.nan, "b": (1.0, np.inf)}) == {"a": None, "b": [1.0, None]}


def test_points_and_checksums_are_those_that_tensorboard_reads(tmp_path):
    """Whatever the length of a tag, and beyond float32; a wrong checksum would end the reading."""
    values = {"aid": 0.1, "é" * 200: np.nan, "rls": 1e300, "zero": 0.0, "x" * 130: -1.5}
    with TensorBoardWriter(tmp_path) as board:
        for step in (0, 750, 2**40):
            board.scalars(values, step, "heron/aid")
    (path,) = (tmp_path / "heron" / "aid").glob("events*")
    points = {}
    for event in EventFileLoader(str(path)).Load():
        for point in event.summary.value:
            (points[point.tag, event.step],) = point.tensor.float_val
    with np.errstate(over="ignore"):
        expected = {(name, step): np.float32(value)
                    for name, value in values.items() for step in (0, 750, 2**40)}  # fmt: skip
    assert points.keys() == expected.keys()
    np.testing.assert_array_equal(list(points.values()), [expected[key] for key in points])


@pytest.mark.thorough
def test_runs_keep_their_order_and_a_resumed_one_drops_what_came_later(tmp_path):
    """TensorBoard gives colours by the times of the first events; later points never come before them."""
    names = [f"boat/{chr(122 - k)}" for k in range(20)]
    with TensorBoardWriter(tmp_path, names) as board:
        for name in reversed(names):
            board.scalars({"a": 1.0}, 5, name)
        board.text("told", "*yes*", run="boat/a")
    assert list(boards(tmp_path))[:20] == names
    time.sleep(1.0)  # files are read in the order of the seconds at which they began
    with TensorBoardWriter(tmp_path, names, {name: 4 for name in names}) as board:  # resumed
        board.scalars({"a": 2.0}, 4, names[3])
    read = boards(tmp_path)
    assert list(read)[:20] == names
    assert values(read[names[3]], "a") == [2.0] and values(read[names[4]], "a") == []
    assert texts(read["boat/a"]) == {"told": "*yes*"}


def test_descriptions_come_with_the_first_point_of_each_tag(tmp_path):
    with TensorBoardWriter(tmp_path, about=lambda tag: f"about {tag}") as board:
        board.scalars({"a": 1.0}, 0)
        board.scalars({"a": 2.0, "b": 3.0}, 1)
    (events,) = boards(tmp_path).values()
    assert values(events, "a") == [1.0, 2.0] and values(events, "b") == [3.0]
    assert {tag: events.SummaryMetadata(tag).summary_description for tag in "ab"} == {"a": "about a", "b": "about b"}


def test_what_is_written_can_be_read_while_the_run_goes_on(tmp_path):
    board = TensorBoardWriter(tmp_path)
    board.scalars({"a": 1.0}, 0, "one")
    board.flush()
    assert values(boards(tmp_path)["one"], "a") == [1.0]
    board.close()
