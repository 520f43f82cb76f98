"""Each export is opened by the program that it is for, and its numbers are those of the model."""

import csv
import io
import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.support.fitted_boats import TOP
from tests.support.fitted_boats import boat as fitted_parameters
from tests.support.surge_models import some
from usvlearn import Inputs, Online
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.model.export.c_header import c_header, identifier
from usvlearn.model.export.casadi_text import casadi_text
from usvlearn.model.export.described import conventions
from usvlearn.model.export.formats import FORMATS, mat_file
from usvlearn.model.export.onnx_network import onnx_networks
from usvlearn.model.export.predictions import csv_table, mcap_file, stretches
from usvlearn.model.surge import WITHOUT_EVEN, SurgeModel

PROGRAM = """#include <stdio.h>
#include "boat.h"
int main(void) {
    double x[5], y;
    while (fread(x, sizeof(double), 5, stdin) == 5) {
        y = NAME_surge_step(x[0], x[1], x[2], x[3], x[4]);
        if (fwrite(&y, sizeof(double), 1, stdout) != 1) return 1;
    }
    return 0;
}
"""


def without_even(boat):
    """The same boat with a model that has no fore-aft asymmetry terms."""
    return boat._replace(model=SurgeModel(boat.model.mass, {k: boat.model.coefficients[k] for k in WITHOUT_EVEN}))


@pytest.mark.thorough
def test_the_c_header_prints_no_number_for_what_is_not_known(boat):
    vague = replace(boat.identified, unknown=frozenset({"thrust_ratio"}))
    rows = c_header(boat._replace(identified=vague)).splitlines()
    (row,) = [each for each in rows if each.startswith(" * thrust_ratio")]
    assert row.split() == ["*", "thrust_ratio", "not", "known", "yet", "left/right"]
    (row,) = [each for each in rows if each.startswith(" * time_constant ")]
    assert float(row.split()[2]) == pytest.approx(boat.identified["time_constant"].value, rel=1e-4)


def fitted(boat):
    """The same boat with a model that has tables and a thruster's time constant."""
    model = SurgeModel.fitted(fitted_parameters(), TOP, boat.model.mass)
    return boat._replace(model=replace(model, thruster=0.11))


@pytest.mark.parametrize("even", [True, False, "tables"])
def test_the_c_header_compiles_strictly_and_makes_the_step(boat, even, tmp_path):
    if (gcc := shutil.which("gcc") or shutil.which("cc")) is None:
        pytest.skip("needs a C compiler")
    hostile = "b */ *\\ *ü/\n/ int x; ??/"
    boat = boat._replace(name=hostile) if even else without_even(boat)._replace(name="b")
    boat = fitted(boat) if even == "tables" else boat
    name = identifier(boat.name)
    (tmp_path / "boat.h").write_text(c_header(boat), "ascii")
    (tmp_path / "main.c").write_text(PROGRAM.replace("NAME", name))
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-std=c99", "-O2"]
    comment = (tmp_path / "boat.h").read_text().partition("#ifndef")[0]
    assert comment.count("*/") == comment.count("/*") == 1 and "??" not in comment and "\\" not in comment
    subprocess.run([gcc, *strict, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    rows = some(np.random.default_rng(0), 100_000)
    done = subprocess.run([tmp_path / "main"], input=rows.tobytes(), capture_output=True, check=True)
    np.testing.assert_allclose(np.frombuffer(done.stdout), boat.model.step(*rows.T), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("even", [True, False, "tables"])
def test_casadi_has_the_step_and_its_jacobian(boat, even):
    pytest.importorskip("casadi", reason="needs the package casadi")
    boat, module = fitted(boat) if even == "tables" else boat if even else without_even(boat), {}
    exec(compile(casadi_text(boat), "boat_casadi", "exec"), module)  # our own text
    step = module["surge_step"]()
    slopes = step.factory("slopes", step.name_in(), [f"jac:v_next:{name}" for name in step.name_in()])
    rows, h = some(np.random.default_rng(3), 400), 1e-6
    rows[:40, 4] *= 1e-6  # φ₁ near 0
    expected = boat.model.step(*rows.T)
    np.testing.assert_allclose([float(step(*row)) for row in rows], expected, rtol=1e-12, atol=1e-12)
    jacobian = np.array([[float(each) for each in slopes(*row)] for row in rows])
    ends = [boat.model.step(*(rows + sign * h * np.eye(5)[:, None]).transpose(2, 0, 1)) for sign in (1, -1)]
    smooth = (np.abs(rows) > 1e-3).all(1)  # at 0 an absolute value has no derivative
    if even == "tables":
        away = np.abs(rows[:, :3] / [boat.model.tables.speeds[0], 0.125, 0.125])  # no node between the ends
        smooth &= (np.abs(away - away.round()) > 1e-3).all(1)
    np.testing.assert_allclose(jacobian[smooth], ((ends[0] - ends[1]) / (2 * h)).T[smooth], rtol=1e-6, atol=1e-6)
    assert smooth.sum() > 200


def test_the_network_is_the_same_in_onnx(boat):
    runtime = pytest.importorskip("onnxruntime", reason="needs the package onnxruntime")
    pytest.importorskip("onnx", reason="needs the package onnx")
    (content,) = onnx_networks(boat).values()
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    rng, online = np.random.default_rng(4), Online.of(boat.leaves, boat.facts)
    place = online.names.index("rnn")
    for _ in range(20):
        surge, left, right, heading = rng.uniform([0, -1, -1, 0], [3, 1, 1, 6.28])
        online.state = {**online.state, "members.rnn.surge": np.array(surge)}
        expected = online.predict_members(Inputs(left, right, heading, 0.0, 0.4))[online.names[place]][0]
        given = (surge, np.sin(heading), np.cos(heading), left, right)
        feeds = {each.name: np.array([x]) for each, x in zip(session.get_inputs(), given, strict=True)}
        assert session.run(None, feeds)[0] == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_json_is_read_again_as_the_model(boat, run):
    (content,) = FORMATS["json"].files(boat, run).values()
    read = json.loads(content, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    again = SurgeModel(read["mass"]["value"], {name: each["value"] for name, each in read["model"].items()})
    assert again == boat.model
    top = read["identified"]["quantities"]["steady_speed_full"]
    assert top["low"] < top["value"] < top["high"] and top["unit"] == "m/s"
    curve = read["curves"]["steady_speed"]
    assert curve["value"][-1] == pytest.approx(top["value"]) and curve["unit"] == "m/s"
    assert read["commands"]["command_left"]["span"] == 1.0
    assert "coefficients of drag are negative" in read["signs"] and read["mass"]["unit"] == "kg"


def test_mat_is_read_again_by_scipy(boat):
    from scipy.io import loadmat

    read = loadmat(io.BytesIO(mat_file(boat)), simplify_cells=True)["boat"]
    assert read["model"]["drag_linear"]["value"] == boat.model.coefficients["drag_linear"]
    assert read["identified"]["quantities"]["thrust_full_left"]["low"] == boat.identified["thrust_full_left"].low
    np.testing.assert_array_equal(read["covariance"]["matrix"], boat.identified.covariance)
    assert list(read["covariance"]["parameters"])[:1] == ["drag_quadratic"]
    assert read["covariance"]["matrix"].dtype == np.float64  # a matrix in MATLAB, not a cell of numbers
    assert isinstance(read["model"]["drag_linear"]["value"], float)


@pytest.mark.parametrize("element", [0, 1])
def test_csv_has_what_the_run_published(boat, run, element):
    name = f"heron{element + 1}"
    rows = list(csv.DictReader(csv_table(stretches(run, name)).decode().splitlines()))
    arrays = [np.load(path) for path in sorted((run / "predictions").glob("*.npz"))]
    for key, column in (("time", "time"), ("measured_surge", "measured_surge"), ("command_left", "command_left")):
        array = np.array([float(row[column] or "nan") for row in rows])
        np.testing.assert_array_equal(array, np.concatenate([each[key][:, element] for each in arrays]))
    place = arrays[0]["estimators"].tolist().index("ensemble")
    for column, key in (("ensemble", "predictions"), ("ensemble_halfwidth", "halfwidths")):
        array = np.array([float(row[column] or "nan") for row in rows])
        expected = np.concatenate([each[key][:, element, place] for each in arrays])
        np.testing.assert_array_equal(array, np.where(np.isinf(expected), np.nan, expected))  # the first ten intervals
    assert len({row["run"] for row in rows}) == 2


def test_mcap_is_read_again_and_its_runs_follow_each_other(run):
    pytest.importorskip("mcap", reason="needs the package mcap")
    from mcap.reader import make_reader

    reader = make_reader(io.BytesIO(mcap_file("heron1", stretches(run, "heron1"))))
    messages = [
        (channel.topic, message.log_time, json.loads(message.data)) for _, channel, message in reader.iter_messages()
    ]
    measured = [(stamp, row) for topic, stamp, row in messages if topic == "/usvlearn/measured"]
    predicted = [row for topic, _, row in messages if topic == "/usvlearn/predicted"]
    rows = list(csv.DictReader(csv_table(stretches(run, "heron1")).decode().splitlines()))
    assert len(measured) == len(predicted) == len(rows)
    assert [row["time"] for _, row in measured] == [float(row["time"]) for row in rows]
    assert [row.get("ensemble") for row in predicted] == [
        float(row["ensemble"]) if row["ensemble"] else None for row in rows
    ]
    stamps = np.array([stamp for stamp, _ in measured])
    assert (np.diff(stamps) > 0).all() and (np.diff(stamps) >= 9e9).sum() == 1
    assert {each.name for each in reader.iter_metadata()} == {"runs", "boat"}


def test_every_simulator_has_the_same_boat(boat):
    """Steady speeds under a force, from each simulator's own equation and signs."""
    names = conventions(without_thrust_loss(boat.model))
    force = names["mss"]["thrust_full_left"] + names["mss"]["thrust_full_right"]

    def settled(acceleration) -> float:
        speed = 0.0
        for _ in range(20_000):
            speed += 0.002 * acceleration(speed)
        return speed

    mss, gz, vrx = names["mss"], names["gz_sim"], names["vrx"]
    speeds = [
        settled(lambda u: (mss["Xu"] * u + mss["Xuu"] * abs(u) * u + force) / (mss["m"] - mss["Xudot"])),
        settled(lambda u: ((gz["xU"] + gz["xUabsU"] * abs(u)) * u + force) / (gz["mass"] - gz["xDotU"])),
        settled(lambda u: (-(vrx["xU"] + vrx["xUU"] * abs(u)) * u + force) / (vrx["mass"] + vrx["xDotU"])),
    ]
    expected = float(without_thrust_loss(boat.model).ahead.steady_speed(1.0))
    np.testing.assert_allclose(speeds, expected, rtol=1e-6)
    assert gz["xU"] < 0 < vrx["xU"]


def without_thrust_loss(model: SurgeModel) -> SurgeModel:
    return SurgeModel(
        model.mass, {name: 0.0 if "speed" in name else value for name, value in model.coefficients.items()}
    )


def test_a_damaged_file_of_predictions_is_told(run, tmp_path):
    shutil.copytree(run / "predictions", tmp_path / "predictions")
    first = min((tmp_path / "predictions").glob("*.npz"))
    content = bytearray(first.read_bytes())
    for damaged in (content[:-100], content[:300], b"", b"PK\x03\x04" + bytes(100)):
        first.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="is damaged"):
            csv_table(stretches(tmp_path, "heron1"))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("estimators", lambda x: np.array("aid")),
        ("time", lambda x: x + 1.1e8),
        ("time", lambda x: x - 1e4),
        ("time", lambda x: x[:, 0]),
        ("predictions", lambda x: x.astype(np.longdouble)),
        ("runs", lambda x: np.array(["a\ud800", "b"])),
        ("estimators", lambda x: x[::-1]),  # of the last file
    ],
)
def test_arrays_of_another_kind_are_damage_or_harmless(run, tmp_path, name, change):
    shutil.copytree(run / "predictions", tmp_path / "predictions")
    files, other = sorted((tmp_path / "predictions").glob("*.npz")), name == "estimators" and change(np.arange(2)).ndim
    first = files[-1] if other else files[0]
    arrays = dict(np.load(first))
    np.savez(first, **{**arrays, name: change(arrays[name])})
    if name == "runs":
        assert csv_table(stretches(tmp_path, "heron1")).decode().splitlines()[1].startswith("a?,")
        return
    with pytest.raises(CheckpointError, match="expected those of the runs before" if other else "is damaged"):
        csv_table(stretches(tmp_path, "heron1"))


def test_a_network_that_diverged_is_refused(boat):
    pytest.importorskip("onnx", reason="needs the package onnx")
    leaves = {**boat.leaves, "members.rnn.weights.a": boat.leaves["members.rnn.weights.a"] * np.nan}
    with pytest.raises(ConfigError, match="not finite"):
        onnx_networks(boat._replace(leaves=leaves))


@pytest.mark.thorough
def test_nothing_of_it_needs_torch():
    code = "import usvlearn.cli.export, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
