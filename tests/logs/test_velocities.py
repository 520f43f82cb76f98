"""Logs with surge, sway and yaw rate: each component as the surge alone, and what cannot be read."""

import numpy as np
import pytest

from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.alignment.align import align
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import read_recordings
from usvlearn.logs.velocities import read_velocities

INPUTS = {"command_left": {"name": "L"}, "command_right": {"name": "R"}, "heading": {"name": "psi"}}
COMPONENTS = {name: {"name": name} for name in ("surge", "sway", "yaw_rate")}


def write(path, change=None, count: int = 200):
    rng = np.random.default_rng(0)
    rows = []
    for k in range(count):
        row = [f"{k / 10:g}", "0.5", "0.25", "0.1", *(f"{x:.4f}" for x in rng.normal(size=3))]
        rows.append((change or (lambda k, row: row))(k, row))
    path.write_text("\n".join(",".join(row) for row in [["t", "L", "R", "psi", *COMPONENTS], *rows]))
    return path


def test_each_component_is_aligned_as_the_surge_alone(tmp_path):
    path = write(tmp_path / "run.csv")
    (run,) = read_velocities(path, Table("t"), INPUTS, COMPONENTS, dt=0.4)
    assert run.name == "run" and run.samples.velocity.shape == (len(run.time), 3) and run.samples.measured[1:].all()
    for k, name in enumerate(COMPONENTS):
        (recording,) = read_recordings(path, Table("t"), {**INPUTS, "surge": {"name": name}})
        alone = align(recording.channels, dt=0.4)
        np.testing.assert_array_equal(run.samples.velocity[:, k], alone.samples.surge)
        np.testing.assert_array_equal(run.time, alone.time)
        np.testing.assert_array_equal(run.samples.inputs.command_left, alone.samples.inputs.command_left)


def test_a_component_that_is_missing_for_a_while_is_not_measured_there(tmp_path):
    def change(k, row):
        return [*row[:5], "" if 50 <= k < 100 else row[5], row[6]]

    (run,) = read_velocities(write(tmp_path / "run.csv", change), Table("t"), INPUTS, COMPONENTS, dt=0.4)
    away = (run.time > 5.5) & (run.time < 9.0)
    assert away.sum() > 5 and not run.samples.measured[away, 1].any()
    assert run.samples.measured[away][:, [0, 2]].all() and run.samples.fresh[away].all()


def test_a_limit_rejects_messages_of_its_component(tmp_path):
    def change(k, row):
        return [*row[:5], "7.0" if k % 8 == 4 else row[5], "7.0" if k % 8 == 4 else row[6]]

    path = write(tmp_path / "run.csv", change)
    (run,) = read_velocities(path, Table("t"), INPUTS, COMPONENTS, limits={"yaw_rate": 5.0}, dt=0.4)
    assert np.nanmax(run.samples.velocity[:, 1]) == 7.0 and np.nanmax(run.samples.velocity[:, 2]) < 5


WRONG = [  # arguments, and what the error says
    ({"components": {**COMPONENTS, "sway": {"name": "nothing"}}}, r"components\.sway\.name: .*'nothing'"),
    (
        {"components": {**COMPONENTS, "sway": {"name": "sway", "unit": "feet"}}},
        r"^components\.sway\.unit: found 'feet'",
    ),
    ({"components": {}}, "found no component"),
    ({"components": ("surge", "sway")}, r"components: found \('surge', 'sway'\), expected where each is logged"),
    ({"channels": {**INPUTS, "surge": {"name": "surge"}}}, "found surge among"),
    ({"limits": {"yawrate": 3.0}}, "limits: found 'yawrate', expected components: surge, sway, yaw_rate"),
    ({"path": "none"}, "^path: found"),
]


@pytest.mark.parametrize(("changed", "message"), WRONG)
def test_what_is_wrong_is_named(changed, message, tmp_path):
    call = {"path": "run.csv", "channels": INPUTS, "components": COMPONENTS, "dt": 0.4, **changed}
    write(tmp_path / "run.csv")
    with pytest.raises((ConfigError, LogFormatError), match=message):
        read_velocities(reader=Table("t"), **{**call, "path": tmp_path / call["path"]})


def test_components_with_other_stamps_are_refused(tmp_path):
    def change(k, row):  # the yaw rate comes later
        return [*row[:6], row[6] if k > 5 else ""]

    with pytest.raises(LogFormatError, match="run: found other stamps of yaw_rate than of surge, expected both in the"):
        read_velocities(write(tmp_path / "run.csv", change), Table("t"), INPUTS, COMPONENTS, dt=0.4)


@pytest.mark.slow
def test_real_bags_have_all_three(real_logs):
    inputs = {
        "command_left": {"name": "*left_thruster", "span": 36.5},
        "command_right": {"name": "*right_thruster", "span": 36.5},
        "heading": {"name": "*ins_pose", "field": "theta", "unit": "rad"},
    }
    fields = zip(COMPONENTS, "xyz", strict=True)
    components = {name: {"name": "*local_vel", "field": field} for name, field in fields}
    runs = read_velocities(real_logs / "vtec", Rosbag(), inputs, components, dt=0.2)
    assert len(runs) == 18
    for run in runs:
        assert run.samples.measured.mean() > 0.9
