"""The planar model in each format makes the simulation of `PlanarModel`, and a run without it exports what it did."""

import dataclasses
import json
import shutil
import subprocess
import warnings

import numpy as np
import pytest

from tests.support.planar_models import commanded, drawn_planar, learned, moving, save_planar
from usvlearn.__main__ import main
from usvlearn.core import checkpoint
from usvlearn.core.checkpoint import checkpoints
from usvlearn.model.export.c_header import c_header, identifier
from usvlearn.model.export.formats import FORMATS
from usvlearn.model.export.planar_boat import read_planar
from usvlearn.model.planar import Motion, PlanarModel
from usvlearn.model.read_boats import read_boats
from usvlearn.model.surge import SurgeModel

STEPS = 300
PROGRAM = """#include <stdio.h>
#include "b_planar.h"
int main(void) {
    NAME_planar_state s;
    double x[5];
    if (fread(&s, sizeof s, 1, stdin) != 1) return 1;
    while (fread(x, sizeof(double), 5, stdin) == 5) {
        s = NAME_planar_step(s, x[0], x[1], x[3], x[4], x[2]);
        if (fwrite(&s, sizeof s, 1, stdout) != 1) return 1;
    }
    return 0;
}
"""


@pytest.fixture
def folder(run, tmp_path):
    """A run of one boat, in which nothing was learned beside the surge."""
    shutil.copytree(run / "checkpoints" / "heron1", tmp_path / "run" / "checkpoints" / "heron1")
    return tmp_path / "run"


@pytest.fixture(params=[True, False], ids=["sway", "no sway"])
def planar(request, folder):
    """A boat of a run that learned a yaw rate, and perhaps a sway."""
    model = drawn_planar(np.random.default_rng(5), request.param)
    save_planar(folder, "heron1", learned(model))
    boat = read_planar(*read_boats(folder), folder)
    assert boat is not None and boat.model == dataclasses.replace(model, surge=boat.boat.model)
    return boat


def simulated(model: PlanarModel) -> tuple[Motion, np.ndarray, np.ndarray]:
    """A start, some steps `(5, time)` from it, and the states after them, `(time, 6)`."""
    rng = np.random.default_rng(6)
    start, given = moving(rng), commanded(rng, STEPS)
    return start, given, np.stack(model.simulate(start, *given[:3], given[3:]), -1)


def test_the_c_header_compiles_strictly_and_makes_the_simulation(planar, tmp_path):
    if (gcc := shutil.which("gcc") or shutil.which("cc")) is None:
        pytest.skip("needs a C compiler")
    boat = planar.boat._replace(name="b */ *\\ *ü/\n/ int x; ??/")
    name = identifier(boat.name)
    (content,) = FORMATS["c"].planar(planar._replace(boat=boat)).values()
    (tmp_path / "b_planar.h").write_bytes(content)
    (tmp_path / f"{name}_surge.h").write_text(c_header(boat), "ascii")
    (tmp_path / "main.c").write_text(PROGRAM.replace("NAME", name))
    comment = content.decode("ascii").partition("#ifndef")[0]
    assert comment.count("*/") == comment.count("/*") == 1 and "??" not in comment and "\\" not in comment
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-std=c99", "-O2"]
    subprocess.run([gcc, *strict, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    start, given, expected = simulated(planar.model)
    sent = np.array(start).tobytes() + given.T.tobytes()
    done = subprocess.run([tmp_path / "main"], input=sent, capture_output=True, check=True)
    np.testing.assert_allclose(np.frombuffer(done.stdout).reshape(-1, 6), expected, rtol=1e-12, atol=1e-12)


def test_casadi_makes_the_simulation_and_has_its_jacobian(planar):
    pytest.importorskip("casadi", reason="needs the package casadi")
    (content,) = FORMATS["casadi"].planar(planar).values()
    module: dict = {}
    exec(compile(content, "boat_planar_casadi", "exec"), module)  # our own text
    step = module["planar_step"]()
    start, given, expected = simulated(planar.model)
    state, states = np.array(start), []
    for left, right, dt, *current in given.T:
        state = np.array(step(state, [left, right], current, dt)).ravel()
        states.append(state)
    np.testing.assert_allclose(states, expected, rtol=1e-12, atol=1e-12)
    slopes = step.factory("slopes", step.name_in(), ["jac:state_next:state", "jac:state_next:command"])
    h, smooth = 1e-6, 0
    for state, (left, right, dt, *current) in zip(expected[:60], given.T, strict=False):
        x = np.array([*state, left, right])
        ends = x + h * np.concatenate([np.eye(8), -np.eye(8)])
        after = np.stack(planar.model.step(Motion(*ends.T[:6]), *ends.T[6:], dt, tuple(current)), -1)
        if (np.abs(x[[0, 2, 6, 7]]) > 1e-3).all():  # at 0 an absolute value has no derivative
            jacobian = np.hstack([np.array(each) for each in slopes(state, x[6:], current, dt)])
            np.testing.assert_allclose(jacobian, (after[:8] - after[8:]).T / (2 * h), rtol=1e-6, atol=1e-6)
            smooth += 1
    assert smooth > 40


def test_json_is_read_again_as_the_model(planar):
    (content,) = FORMATS["json"].planar(planar).values()
    read = json.loads(content, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))

    def numbers(part: str) -> dict | None:
        return read[part] and {name: each["value"] for name, each in read[part]["model"].items()}

    surge = SurgeModel(read["surge"]["mass"]["value"], numbers("surge"))
    assert PlanarModel(surge, numbers("yaw"), numbers("sway")) == planar.model
    assert read["yaw"]["model"]["linear"]["unit"] == "1/s" and read["yaw"]["learned"]["updates"] == 100
    assert (read["sway"] is None) == (read["lacks"] != []) == (planar.model.sway is None)
    assert read["set"]["planar"]["file"] == planar.path.name and "to starboard" in read["signs"]


def exported(folder, capsys, formats="json,c,casadi") -> tuple[list[str], str]:
    """The names of the files that the command wrote, and what it said."""
    assert main(["export", str(folder), "--to", formats]) == 0
    said = capsys.readouterr()
    return [line.rpartition("/")[2] for line in said.out.splitlines()], said.err


def test_a_run_without_a_planar_model_exports_what_it_did(folder, capsys):
    before, _ = exported(folder, capsys)
    contents = {each.name: each.read_bytes() for each in (folder / "export").iterdir()}
    save_planar(folder, "heron1", learned(drawn_planar(np.random.default_rng(5))))
    after, said = exported(folder, capsys)
    assert before == ["heron1.json", "heron1_surge.h", "heron1_casadi.py"]
    assert after == [*before, "heron1_planar.json", "heron1_planar.h", "heron1_planar_casadi.py"]
    assert {name: (folder / "export" / name).read_bytes() for name in before} == contents
    assert "sway was measured" not in said


def test_a_sway_that_was_never_measured_is_told(planar, folder, capsys):
    _, said = exported(folder, capsys)
    sentence = "heron1: The sway was measured 0 times, expected 20: v is 0 in the planar model."
    assert (sentence in " ".join(said.split())) == (planar.model.sway is None)
    assert ("The sway was measured 0 times" in (folder / "export" / "heron1_planar.h").read_text()) == (
        planar.model.sway is None
    )


def test_a_yaw_rate_that_was_never_measured_makes_no_planar_model(folder, capsys):
    save_planar(folder, "heron1", {"yaw.members.yaw.updates": np.array(19.0)})
    with pytest.warns(UserWarning, match="planar model of heron1 is left out: its yaw rate was measured 19 times"):
        names, _ = exported(folder, capsys)
    assert not any("planar" in each for each in names)


def damaged(path):
    path.write_bytes(path.read_bytes()[:-100])


def of_another_kind(path):
    leaves, facts = checkpoint.load(checkpoints(path.parents[3] / "checkpoints" / "heron1")[-1])
    checkpoint.save(path, leaves, **facts)


def diverged(path):
    leaves, facts = checkpoint.load(path)
    checkpoint.save(path, {**leaves, "yaw.members.yaw.mean": leaves["yaw.members.yaw.mean"] * np.nan}, **facts)


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (damaged, "none of its 1 checkpoints can be read"),
        (of_another_kind, "found an estimator of the kind ensemble, expected planar"),
        (diverged, "yaw.bias: found nan, expected a finite number"),
    ],
)
def test_bad_checkpoints_are_told_in_one_sentence_and_all_leaves_them_out(folder, capsys, harm, words, told):
    harm(save_planar(folder, "heron1", learned(drawn_planar(np.random.default_rng(5)))))
    said = told(folder, "--to", "json,c")
    assert said.startswith("error: ") and words in said, said
    assert not (folder / "export").exists()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        names, _ = exported(folder, capsys, "all")
    assert any("the planar model of heron1 is left out: " in str(each.message) for each in caught)
    assert "heron1.json" in names and not any("planar" in each for each in names)


def test_the_folder_of_what_was_learned_beside_names_the_run(folder, told):
    save_planar(folder, "heron1", {})
    for given in (folder / "planar", folder / "planar" / "checkpoints" / "heron1"):
        assert told(given, "--to", "c").endswith(f"that learned sway and yaw rate: give {folder}")


def test_a_boat_named_like_the_planar_file_of_another_is_not_mixed(folder, told):
    shutil.copytree(folder / "checkpoints" / "heron1", folder / "checkpoints" / "heron1_planar")
    for path in checkpoints(folder / "checkpoints" / "heron1_planar"):
        leaves, facts = checkpoint.load(path)
        checkpoint.save(path, leaves, **{**facts, "boat": "heron1_planar"})
    save_planar(folder, "heron1", learned(drawn_planar(np.random.default_rng(5))))
    assert "whose files would have one name, heron1_planar.json" in told(folder, "--to", "json")
    assert not (folder / "export").exists()
