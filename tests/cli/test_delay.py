"""`usvlearn delay`: it finds a delay that is there, invents none, and says what is wrong with what it is given."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support import few
from usvlearn import SIFtRLS, SurgeDynamics
from usvlearn.__main__ import main
from usvlearn.cli.delay import DELAYS, Half, choose, find_halves
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings

CHANNELS = {"command_left": {"name": "L"}, "command_right": {"name": "R"},
            "heading": {"name": "psi", "unit": "deg"}, "surge": {"name": "v"}}  # fmt: skip
KEYS = [f"data.channels.{key}.name={each['name']}" for key, each in CHANNELS.items()]


def write(folder: Path, name: str, delay: float, seconds: float = 120, seed: int = 0, answers: bool = True) -> Path:
    """The log of a boat with a time constant of 1 s that hears its commands late, or not at all; 10 Hz."""
    rng = np.random.default_rng(seed)
    count, late = round(seconds * 10), round(delay * 10)
    command = np.repeat(rng.uniform(-1, 1, count // 7 + 1), 7)[:count]
    heard = np.append(np.zeros(late), command)[:count] if answers else rng.uniform(-1, 1, count)
    speed, rows = 0.0, ["t,L,R,psi,v"]
    for k in range(count):
        rows.append(f"{k / 10},{command[k]:.4f},{command[k]:.4f},90,{speed + rng.normal(0, 0.01):.6f}")
        speed += 0.1 * (2 * heard[k] - speed)
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.csv"
    path.write_text("\n".join(rows))
    return path


def halves(path: Path | dict[str, Path]) -> tuple[Half, Half]:
    model = SIFtRLS(SurgeDynamics(28.0), memory=30.0)
    return find_halves(read_recordings(path, Table("t"), CHANNELS), model, {"dt": 0.4})


@pytest.mark.parametrize("delay", few([0.0, 0.2, 0.5], [0.0, 0.2], "thorough"))
def test_the_delay_of_a_boat_is_found(delay, tmp_path):
    for seed in range(3):
        first, second = halves(write(tmp_path, f"boat{seed}", delay, seed=seed))
        place, equal, how = choose(first)
        assert DELAYS[place] == pytest.approx(delay, abs=0.051) and place in equal
        assert ("sure" in how) == (delay > 0)
        if delay:
            assert second.skills[place] - second.skills[0] > 0.1


def test_no_delay_is_chosen_for_a_boat_that_does_not_answer_its_commands(tmp_path):
    for seed in range(3):
        first, _ = halves(write(tmp_path, f"boat{seed}", 0.0, seed=seed, answers=False))
        place, _, how = choose(first)
        assert place == 0 and ("no delay is surely better" in how or how == "the best one")


def test_commands_that_never_change_are_said(tmp_path):
    path = write(tmp_path, "boat", 0.0)
    rows = [",".join([t, "0", "0", *rest]) for t, _, _, *rest in (row.split(",") for row in path.read_text().split())]
    path.write_text("\n".join(["t,L,R,psi,v", *rows[1:]]))
    with pytest.raises(LogFormatError, match="no command ever changes"):
        halves(path)


def test_the_second_half_does_not_choose(tmp_path):
    """Of two runs the first alone chooses, whatever the delay of the second one."""
    for name, delay in (("run_1", 0.2), ("run_2", 0.6)):
        write(tmp_path / "boat", name, delay, 80)
    first, second = halves(tmp_path / "boat")
    assert DELAYS[choose(first)[0]] == pytest.approx(0.2, abs=0.051)
    assert DELAYS[int(second.skills.argmax())] == pytest.approx(0.6, abs=0.101)
    alone, _ = halves(write(tmp_path, "both", 0.2, 160))
    assert len(first.blocks) == len(alone.blocks) == len(second.blocks) == 7


def test_a_delay_shifts_what_the_boat_hears_and_not_which_steps_are_compared(tmp_path):
    write(tmp_path / "boat", "run_1", 0.2, 80), write(tmp_path / "boat", "run_2", 0.2, 80)
    first, second = halves(tmp_path / "boat")
    for half in (first, second):
        assert np.isfinite(half.skills).all() and half.blocks.shape[1] == len(DELAYS)
        np.testing.assert_allclose(half.blocks.mean(0), half.skills, atol=0.15)


def test_several_boats_count_alike(tmp_path):
    """Each boat's skill has the same weight, however long its logs are, and each boat has halves of its own."""
    paths = {"a": write(tmp_path, "a", 0.2, 100), "b": write(tmp_path, "b", 0.2, 300)}
    both, alone = halves(paths), [halves(path) for path in paths.values()]
    for k in range(2):
        np.testing.assert_allclose(both[k].skills, np.mean([each[k].skills for each in alone], 0), atol=1e-12)
    assert DELAYS[choose(both[0])[0]] == pytest.approx(0.2, abs=0.051)


def test_short_logs_and_boats_at_rest_are_told_in_one_sentence(tmp_path):
    with pytest.raises(LogFormatError, match=r"data.path: found \d+ steps .* first half .* expected 100: give longer"):
        halves(write(tmp_path, "short", 0.2, 40))
    path = tmp_path / "rest.csv"
    path.write_text("\n".join(["t,L,R,psi,v", *(f"{k / 10},{k % 7 / 7:.2f},0,90,0" for k in range(1200))]))
    with pytest.raises(LogFormatError, match="the speed never changes in the first half: give logs of a moving boat"):
        halves(path)


def test_the_command_prints_the_delays_and_what_to_write(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    path = write(tmp_path, "boat", 0.4)
    assert main(["delay", "data=csv", f"data.path={path}", "data.reader.time=t", *KEYS]) == 0
    said = capsys.readouterr().out
    assert all(f"\n{delay:.2f} " in said for delay in DELAYS)
    assert "Chosen on the first half: 0.4 s, better than 0 s by" in said and "On the second half 0.4 s is" in said
    line = "data.channels.command_left.delay=0.4 data.channels.command_right.delay=0.4"
    assert f"Configured: 0 s. To change it: {line}\n" in said
    assert main(["delay", "data=csv", f"data.path={path}", "data.reader.time=t", *KEYS, *line.split()]) == 0
    assert "Configured: 0.4 s, which can stay." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["data=simulated"], "data: found no channels, expected logs with commands"),
        (["data=csv"], "data.path is not set"),
        (["data=cvs"], "data: found 'cvs', expected one of alog"),
        (["data=csv", "data.pth=a"], "data.pth: found no such key: did you mean data.path?"),
        (["--multirun", "data=csv"], "--multirun: found a flag of usvlearn train"),
        (["data"], "data: found no value"),
    ],
)
def test_wrong_arguments_end_in_one_sentence(arguments, said, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    with pytest.raises(SystemExit) as caught:
        main(["delay", *arguments])
    error = capsys.readouterr().err
    assert caught.value.code == 2 and error.startswith(f"error: {said}") and error.count("\n") == 1


def test_help_says_how_it_is_called(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    assert main(["delay", "--help"]) == 0 and capsys.readouterr().out.startswith("usage: usvlearn delay my_boat.yaml")
