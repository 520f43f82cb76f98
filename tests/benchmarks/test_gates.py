"""The gates name the leaf and the step where two sources differ first, and nothing where they compute the same."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import gate_values
import numpy as np
import pytest
import torch
from gate_values import digest, first_difference, leaves

from tests.support import ROOT

BENCHMARKS = ROOT / "benchmarks"


class State(NamedTuple):
    surge: torch.Tensor
    theta: torch.Tensor


def case() -> dict:
    generator = np.random.default_rng(0)
    state = State(torch.from_numpy(generator.normal(size=5)), torch.from_numpy(generator.normal(size=(5, 3))))
    return {
        "replay by step": {"state": state, "none": np.full(5, np.nan)},
        "text": "one\ntwo",
        "score": [1, True, None],
    }


def changed(**values: np.ndarray) -> dict:
    """The leaves of the case, some of them replaced; `__` in a name stands for what lies between part and leaf."""
    return leaves(case()) | {name.replace("__", " by step: ").replace("_of_", "."): x for name, x in values.items()}


def test_every_value_is_a_named_leaf():
    named = leaves(case())
    parts = ["replay by step: state.surge", "replay by step: state.theta", "replay by step: none"]
    assert list(named) == [*parts, "text", "score: 0", "score: 1", "score: 2"]
    assert named["text"].tolist() == ["one", "two"] and named["score: 2"].tolist() == ["None"]
    with pytest.raises(TypeError, match="object"):
        leaves({"part": {"leaf": object()}})


def test_the_first_step_that_differs_is_named_then_the_first_leaf():
    surge, theta = (leaves(case())[f"replay by step: state.{name}"].copy() for name in State._fields)
    surge[3] += 1.0
    theta[2, 1] = np.nextafter(theta[2, 1], 9.0)
    first = first_difference(leaves(case()), changed(replay__state_of_surge=surge, replay__state_of_theta=theta))
    assert (first.leaf, first.place) == ("replay by step: state.theta", "step 2 (1)")
    assert first.recorded != first.present and float(first.present) == theta[2, 1]
    surge[2] += 1.0
    first = first_difference(leaves(case()), changed(replay__state_of_surge=surge, replay__state_of_theta=theta))
    assert (first.leaf, first.place) == ("replay by step: state.surge", "step 2")


@pytest.mark.parametrize(
    ("recorded", "present", "place"),
    [
        (0.0, -0.0, "as a whole"),
        (np.zeros(3), np.zeros(4), "as a whole"),
        (np.zeros(3), np.zeros(3, np.float32), "as a whole"),
        (np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]), "place 1 (1)"),
        ("a\nb\nc", "a\nc", "place 1"),
        ("a\nb\nc", "a\nb", "place 2"),
        ("a", 1.0, "as a whole"),
        (True, False, "as a whole"),
    ],
)
def test_what_differs_in_a_bit_a_type_a_shape_or_a_line(recorded, present, place):
    old, new = leaves({"part": recorded}), leaves({"part": present})
    assert first_difference(old, new).place == first_difference(new, old).place == place
    assert digest(old) != digest(new)


TOY = {
    "benchmarks/gate_cases.py": """
import numpy as np
from usvlearn.toy import step

def cases(shared):
    def run():
        return {"replay by step": {"surge": np.array([step(k) for k in range(9)])}}
    return {"steps/toy": run, "runs/away": lambda: None}
""",
    "benchmarks/pages.py": "def hardware():\n    return 'any'\n",
    "usvlearn/__init__.py": "",
    "usvlearn/toy.py": "def step(k):\n    return 0.5 * k\n",
    "usvlearn/core/jit.py": "import os\nfrom pathlib import Path\n\ndef folder(source):\n"
    "    return Path(os.environ['XDG_CACHE_HOME']) / 'kernels'\n",
    "certify/none.py": "",
    "configs/none.yaml": "",
    "tests/__init__.py": "",
    "tests/support/none.py": "",
}


@pytest.mark.thorough
def test_the_command_records_compares_and_names_what_a_change_changed(tmp_path):
    """In a small repository with one case, whose record is committed with the change that it records."""
    repository = tmp_path / "repository"
    for name, text in TOY.items():
        (repository / name).parent.mkdir(parents=True, exist_ok=True)
        (repository / name).write_text(text)
    for name in ("gates.py", Path(gate_values.__file__).name):
        (repository / "benchmarks" / name).write_text((BENCHMARKS / name).read_text())
    toy = repository / "usvlearn" / "toy.py"
    environment = {name: x for name, x in os.environ.items() if not name.startswith(("GIT_", "PYTHONPATH"))}

    def done(*command: str | Path, cache: str = "one") -> subprocess.CompletedProcess:
        variables = environment | {"XDG_CACHE_HOME": str(tmp_path / cache), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(command, cwd=repository, env=variables, capture_output=True, text=True)

    def gates(*arguments: str, cache: str = "one") -> subprocess.CompletedProcess:
        return done(sys.executable, "benchmarks/gates.py", *arguments, cache=cache)

    assert done("git", "init", "-q").returncode == 0
    assert gates("record").stderr == ""
    equal = gates("--only", "")
    assert equal.returncode == 0 and "steps         equal (1 equal)" in equal.stdout and "away" in equal.stdout
    assert "--only: found step/, expected" in gates("--only", "steps", "--only", "step/").stderr
    toy.write_text(toy.read_text().replace("0.5 * k", "0.5 * k if k < 4 else 2.5"))
    expected = "steps/toy: replay by step: surge, step 4: recorded 2.0, now 2.5"
    changed = gates("--only", "steps")  # nothing is committed: `record` has kept the source
    assert changed.returncode == 1 and expected in changed.stdout
    lost = gates("--only", "steps", cache="other")
    assert lost.returncode == 1 and "does not hold the recorded source" in lost.stderr
    toy.write_text(TOY["usvlearn/toy.py"])
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    assert done("git", "add", "-A").returncode == done("git", *author, "commit", "-qm", "Record").returncode == 0
    toy.write_text(toy.read_text().replace("0.5 * k", "0.5 * k if k < 4 else 2.5"))
    assert done("git", *author, "commit", "-qam", "Change").returncode == 0
    changed = gates("--only", "steps", cache="third")  # out of the commit before
    assert changed.returncode == 1 and expected in changed.stdout, changed.stderr
