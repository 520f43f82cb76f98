"""The missions of a node and the fit of them after each: what is kept, what is said, and what goes wrong."""

import json
import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.commands import python
from tests.support.live import PLAIN, boat, messages, ready, replayed
from usvlearn.cli import refit as refitting
from usvlearn.cli.refit import refit
from usvlearn.core import checkpoint
from usvlearn.core.events import LOSS, Event
from usvlearn.core.lock import Lock
from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.forecasts.state import TABLE
from usvlearn.live import message_buffer, missions
from usvlearn.live.diagnostics import fit_of
from usvlearn.live.missions import read_refit, settings_of
from usvlearn.live.session import Session
from usvlearn.live.start import Options, channel_options
from usvlearn.live.status import of_health, page, status_lines
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.read_boats import read_boats

MINUTE = list(messages(boat(0.02)))
FITTED = {"time_constant": (1.5, 1.4, 1.6, "s"), "yaw_rate_full": (0.4, 0.3, 0.5, "rad/s")}


class Started:
    """In place of the process of a fit: it has ended at once."""

    pid, code, count = 2**31, 0, 0

    def __init__(self, command, stderr, **_):
        Started.count, Started.command = Started.count + 1, command
        stderr.write(b"warning: a mission is left out")

    def poll(self):
        return self.code

    def kill(self):
        Started.code = -9

    wait = poll


@pytest.fixture
def process(monkeypatch):
    monkeypatch.setattr(missions, "subprocess", SimpleNamespace(Popen=Started, DEVNULL=None))
    Started.code = Started.count = 0
    return Started


def sail(session: Session, sent=MINUTE, shift: float = 0.0) -> list:
    return [step for part, stamp, value in sent for step in session.push(part, stamp + shift, value)]


def silence(session: Session, after: float = 60.0):
    health = session.tick(clock=time.monotonic() + after)
    session._background.wait()
    return health


def told(folder, setup, **changes) -> None:
    known = {"use": True, "missions": 2, "quantities": FITTED, "sentence": "use those of the fit", "seen": {},
             "setup": settings_of(setup)} | changes  # fmt: skip
    (folder / "fit").mkdir(exist_ok=True)
    (folder / "fit" / "refit.json").write_text(json.dumps(known))


def test_states_and_predictions_are_the_same_with_and_without_a_fit(tmp_path, start, process):
    """Also those of a node that goes on from its folder."""
    runs = []
    for on in (False, True):
        for part in range(2):
            with ready(tmp_path / str(on), start, refit=on) as session:
                steps = sail(session, shift=100.0 * part)
                silence(session)
                silence(session, 61.0)
                runs.append((session._node.online.state, [tuple(step)[:8] for step in steps]))
    for (state, steps), (other, others) in zip(runs[:2], runs[2:], strict=True):
        assert np.array_equal(steps, others, equal_nan=True)
        assert all(np.array_equal(leaf, other[name], equal_nan=True) for name, leaf in state.items())
    assert process.count == 2 and not (tmp_path / "False" / "missions").exists()


def test_a_mission_is_kept_where_all_channels_fall_silent_or_the_clock_begins_anew(tmp_path, start, process):
    missions = tmp_path / "missions"
    with ready(tmp_path, start, refit=True, save_period=10.0) as session:
        sail(session)
        session.tick(clock=time.monotonic() + 0.5)
        assert not missions.exists()
        silence(session)
        silence(session, 61.0)
        assert [path.name for path in checkpoint.checkpoints(missions)] == ["00000001.safetensors"]
        sail(session, shift=200.0)
        session.restart()
        sail(session, shift=-1e9)
    leaves, facts = checkpoint.load(checkpoint.checkpoints(missions)[-1])
    assert len(checkpoint.checkpoints(missions)) == 3 and facts["boat"] == "boat"
    assert len(leaves["surge"][0]) == sum(part == "surge" for part, *_ in MINUTE)


def test_a_mission_that_is_short_lies_still_or_lacks_thrust_is_not_kept(tmp_path, start, process):
    still = [(part, stamp, 0.0 if part.startswith("command") else value) for part, stamp, value in MINUTE]
    with ready(tmp_path, start, refit=True) as session:
        told(tmp_path, session.setup)
        for k, sent in enumerate((MINUTE[:500], still)):
            sail(session, sent, 100.0 * k)
            silence(session)
        sail(session, shift=300.0)
        session._node.loss = Event(1.0, LOSS, "left", 0.4)
        health = silence(session)
        assert not health.refit.use and "left thruster gives 40 %" in health.refit.sentence
    assert not checkpoint.checkpoints(tmp_path / "missions")


def test_a_folder_that_looks_like_an_option_is_fitted(tmp_path, start, process, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ready(Path("-node"), start, refit=True) as session:
        sail(session)
        silence(session)
        silence(session, 61.0)
    assert process.command[-2:] == ["fit", str(tmp_path / "-node")]


def test_the_oldest_missions_make_room(tmp_path, start, process, monkeypatch):
    monkeypatch.setattr(missions, "MOST", 100_000)
    for k in range(3):
        with ready(tmp_path, start, refit=True) as session:
            sail(session, shift=100.0 * k)
    assert [path.stem for path in checkpoint.checkpoints(tmp_path / "missions")] == ["00000002", "00000003"]


def test_a_command_that_is_held_is_in_force_in_the_next_mission(tmp_path, start, process):
    changes = channel_options({f"command_{side}.held": "true" for side in ("left", "right")})
    with ready(tmp_path, start, refit=True, channels=changes) as session:
        sail(session, [*MINUTE, *((f"command_{side}", MINUTE[-1][1] + 0.1, 0.5) for side in ("left", "right"))])
        silence(session)
        columns = session._recent.copy()
        assert {name: len(each[0]) for name, each in columns.items()} == {"command_left": 1, "command_right": 1}
        sail(session, [each for each in MINUTE if not each[0].startswith("command")], 100.0)
        columns = session._recent.copy()
    assert [len(columns[name][0]) for name in ("command_left", "command_right")] == [1, 1] < [len(columns["surge"][0])]


def test_a_restarted_node_tells_the_last_fit_and_which_values_to_use(tmp_path, start, process):
    with ready(tmp_path, start, refit=True) as session:
        told(tmp_path, session.setup)
    with ready(tmp_path, start, refit=True) as session:
        sail(session)
        health = session.tick(clock=time.monotonic() + 1)
        (post,) = [each for each in of_health(health) if each.name == "REFIT"]
        assert post.value == "use=fit,missions=2,time_constant=1.5:1.4:1.6,yaw_rate_full=0.4:0.3:0.5"
        shown = "\n".join(page(health))
        assert "Values      use those of the fit" in shown and "time constant         1.5 (1.4 ... 1.6) s" in shown
        assert session._missions.turning({"yaw_rate_full", "mass"}) == {"yaw_rate_full": FITTED["yaw_rate_full"]}
    lines = status_lines(tmp_path)
    assert "Values      use those of the fit" in lines and "Fit         time_constant 1.5 (1.4 ... 1.6) s" in lines
    changed = channel_options({"surge.unit": "knots"})
    with ready(tmp_path, start, refit=True, channels=changed) as session:
        assert not session._missions.told.use and not session._missions.told.quantities
    with ready(tmp_path, start) as session:
        assert session.tick().refit is None


def tables(folder, start, tables, **options) -> list[tuple[float, ...]]:
    """Of the fit that forecasts after each mission, for each table that a fit then gives; [] is one that is doubted."""
    fits = []
    with ready(folder, start, refit=True, **options) as session:
        for k, table in enumerate(tables):
            sail(session, shift=200.0 * k)
            silence(session)
            told(folder, session.setup, use=bool(table), table=table)
            silence(session, 61.0)
            fits.append(fit_of(session._node.online.description))
    return fits


def test_a_fit_that_comes_back_forecasts_too_unless_it_is_doubted(tmp_path, start, process):
    first, second = [1.0] * TABLE, [2.0] * TABLE
    assert tables(tmp_path, start, [[], first, second, []]) == [(), (*first,), (*second,), (0.0,) * TABLE]
    with ready(tmp_path, None, refit=True) as session:
        assert fit_of(session._node.online.description) == (*second,)
        session.tick()
        assert not any(fit_of(session._node.online.description))


@pytest.mark.thorough
def test_the_record_of_a_node_with_a_fit_replays_its_predictions(tmp_path, start, process):
    tables(tmp_path, start, [[1.0] * TABLE])
    with ready(tmp_path, None, record=True) as session:
        steps = [*sail(session, shift=400.0), *session._node.finish()]
        names = session._node.online.names
    predicted = np.array([[step.members.get(name, np.nan) for name in names] for step in steps])
    np.testing.assert_array_equal(replayed(tmp_path / "records"), predicted)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"setup": 1}', '{"use": true, "missions": 1, "quantities": {"a": [1]}, "sentence": ""}',
             '{"use": true, "missions": "x", "quantities": {}, "sentence": ""}', "[" * 100_000,
             '{"use": true, "missions": 1, "quantities": {}, "sentence": "", "table": [1, 2]}']
)  # fmt: skip
def test_a_result_that_is_damaged_ends_nothing(tmp_path, text):
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit" / "refit.json").write_text(text)
    refit = read_refit(tmp_path)
    assert not refit.use and not refit.quantities and refit.sentence


def test_a_fit_that_is_killed_or_runs_already_leaves_the_result_before_it(tmp_path, start, process, monkeypatch):
    with ready(tmp_path, start, refit=True) as session:
        told(tmp_path, session.setup)
    before = (tmp_path / "fit" / "refit.json").read_bytes()
    with Lock(tmp_path / "fit", "x"), pytest.raises(ConfigError, match="is writing there"):
        refit(tmp_path)
    monkeypatch.setattr(refitting, "_read", lambda paths: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        refit(tmp_path)
    assert (tmp_path / "fit" / "refit.json").read_bytes() == before


def test_without_a_speed_the_messages_are_bounded(tmp_path, start, process, monkeypatch):
    monkeypatch.setattr(message_buffer, "MOST", 100)
    with ready(tmp_path, start, refit=True) as session:
        sail(session, [each for each in MINUTE if each[0] != "surge"])
        session.tick()
        assert not session._recent.full


def test_a_fit_that_fails_is_a_warning_and_is_not_tried_again_before_the_next_mission(tmp_path, start, process):
    process.code = -9
    with ready(tmp_path, start, refit=True) as session:
        sail(session)
        silence(session)
        for k in range(3):
            health = silence(session, 62.0 + k)
        assert "the fit of the missions ended with signal 9" in " ".join(health.warnings) and process.count == 1
        assert "is left out" in (tmp_path / "fit" / "fit.log").read_text()
        process.code = 0
        sail(session, shift=100.0)
        silence(session)
        assert process.count == 2 and "fit" not in " ".join(silence(session, 63.0).warnings)


def test_a_fit_that_takes_too_long_is_ended(tmp_path, start, process, monkeypatch):
    process.code = None
    with ready(tmp_path, start, refit=True) as session:
        sail(session)
        silence(session)
        silence(session, 61.0)
        assert "fit" not in " ".join(silence(session, 62.0).warnings) and process.count == 1
        monkeypatch.setattr(missions, "LONGEST", -1.0)
        assert "ended with nothing after" in " ".join(silence(session, 63.0).warnings)
        assert process.code == -9 and session._missions._process is None


def test_every_end_of_a_mission_is_written_before_the_first_is_reported(tmp_path, start, process):
    with ready(tmp_path, start, refit=True) as session:
        for k in range(3):
            sail(session, shift=1000.0 * k)
            session.restart()
    assert len(checkpoint.checkpoints(tmp_path / "missions")) == 3


def test_a_mission_that_is_removed_meanwhile_is_left_out(tmp_path, start, process):
    with ready(tmp_path, start, refit=True) as session:
        sail(session)
    (tmp_path / "missions" / "00000000.safetensors").symlink_to("nowhere")
    with pytest.raises(ConfigError, match="at least 600"):
        refit(tmp_path)


def test_what_is_no_mission_or_of_another_boat_is_left_out_with_a_warning(tmp_path, start, process, capsys):
    for name, k in (("anna", 0), ("boat", 1)):
        with ready(tmp_path, start, refit=True, boat=name) as session:
            sail(session, shift=100.0 * k)
    (tmp_path / "missions" / "00000003.safetensors").write_bytes(b"x" * 30)
    leaves, facts = checkpoint.load(checkpoint.checkpoints(tmp_path / "missions")[0])
    for name, changes in {"1": {"boat": 3}, "2": {"setup": 3}}.items():
        checkpoint.save(tmp_path / "missions" / f"{name}.safetensors", {"surge": leaves["surge"][0]}, **facts | changes)
    with pytest.raises(ConfigError, match="at least 600"):
        refit(tmp_path)
    said = capsys.readouterr().err
    assert said.count("is left out") == 4 and "of another boat" in said
    assert "at least 600" in read_refit(tmp_path).sentence
    with pytest.raises(ConfigError, match="no mission that can be read"):
        refit(tmp_path / "fit")


@pytest.mark.thorough
def test_a_node_fits_its_missions_beside_its_steps(tmp_path, start, capfd):
    """A fit that is killed is a warning; the next mission, or a restart, fits all of them."""

    def wait(session: Session, kill: bool = False):
        for k in range(1000):
            health = silence(session, 60.0 + k)
            if kill and session._missions._process is not None:
                os.kill(session._missions._process.pid, signal.SIGKILL)
                kill = False
            done = session._missions._process is None and (health.refit.missions or health.warnings)
            if done and not kill:
                return health
            time.sleep(0.1)

    log = list(messages(boat(0.2)))
    with ready(tmp_path, start, refit=True) as session:
        sail(session, log)
        assert "signal 9" in " ".join(wait(session, kill=True).warnings)
        sail(session, log, 3600.0)
        health = wait(session)
        assert health.refit.missions == 2 and not any("signal" in each for each in health.warnings)
    assert read_refit(tmp_path, session.setup) == session._missions.told and len(session._missions.told.table) == TABLE
    (refitted,) = read_boats(tmp_path / "fit")
    assert isinstance(refitted.identified, FittedBoat) and refitted.setup == session.setup
    assert health.refit.quantities["time_constant"][0] == pytest.approx(refitted.identified["time_constant"].value)
    before = (tmp_path / "fit" / "refit.json").read_bytes()
    (tmp_path / "fit" / "refit.json").unlink()
    with Session(Options(tmp_path), PLAIN) as session:
        session.start()
        session.wait(300)
        wait(session)
    assert json.loads(before) == json.loads((tmp_path / "fit" / "refit.json").read_bytes())
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.thorough
def test_a_fit_aboard_needs_neither_torch_nor_scipy_nor_rich(tmp_path, start, process):
    with ready(tmp_path, start, refit=True) as session:
        sail(session, list(messages(boat(0.2))))
    code = (
        "import sys; sys.modules.update(dict.fromkeys(['torch', 'scipy', 'hydra', 'omegaconf', 'rich']))\n"
        f"from usvlearn.__main__ import main; sys.exit(main(['fit', {str(tmp_path)!r}]))"
    )
    done = python(code)
    assert done.returncode == 0 and done.stdout.startswith("use those"), done.stderr
