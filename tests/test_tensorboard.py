"""TensorBoard's files, read by TensorBoard."""

import numpy as np
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from usvlearn.tensorboard import TensorBoardWriter


def test_points_and_checksums_are_those_that_tensorboard_reads(tmp_path):
    """Whatever the length of a tag, and beyond float32; a wrong checksum would end the reading."""
    values = {"aid": 0.1, "é" * 200: np.nan, "rls": 1e300, "zero": 0.0, "x" * 130: -1.5}
    with TensorBoardWriter(tmp_path) as board:
        for step in (0, 750, 2**40):
            board.scalars("online/mae/heron", values, step)
    (path,) = tmp_path.glob("events*")
    found = {}
    for event in EventFileLoader(str(path)).Load():
        for point in event.summary.value:
            (found[point.tag, event.step],) = point.tensor.float_val
    with np.errstate(over="ignore"):
        expected = {(f"online/mae/heron/{name}", step): np.float32(value)
                    for name, value in values.items() for step in (0, 750, 2**40)}  # fmt: skip
    assert found.keys() == expected.keys()
    np.testing.assert_array_equal(list(found.values()), [expected[key] for key in found])
