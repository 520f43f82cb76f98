"""The example's logs are read back as what was simulated, and never overwrite a log."""

import numpy as np
import pytest

from usvlearn.__main__ import main
from usvlearn.simulate.example_logs import KINDS, example_logs
from usvlearn.simulate.fleet import fleet


def test_the_logs_hold_what_was_simulated():
    season = fleet(hours=0.1, n=1, mission_minutes=2.0, missions=KINDS, seed=7, aborted_share=0.0, paused_share=0.0)
    for text, recording in zip(example_logs(minutes=2.0).values(), season, strict=True):
        rows = [line.split() for line in text.splitlines() if not line.startswith("%")]
        for variable, channel, unit in (
            ("NAV_SPEED", "surge", 1.0),
            ("DESIRED_THRUST_L", "command_left", 100.0),
            ("DESIRED_THRUST_R", "command_right", 100.0),
        ):
            logged = np.array([float(row[3]) for row in rows if row[1] == variable])
            assert len(logged) > 400
            np.testing.assert_allclose(logged, unit * recording.channels[channel].value, atol=1e-3)


def test_equal_seeds_give_equal_logs():
    first, second, other = (example_logs(minutes=0.5, seed=seed) for seed in (1, 1, 2))
    assert first == second != other


def test_a_log_is_never_overwritten(tmp_path, monkeypatch, capsys):
    (tmp_path / "heron_3.alog").write_text("mine")
    monkeypatch.setattr("sys.argv", ["usvlearn"])
    with pytest.raises(SystemExit, match="2"):
        main(["example", str(tmp_path), "--minutes", "0.5"])
    assert "heron_3.alog: found a log there already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["heron_3.alog"]
    assert (tmp_path / "heron_3.alog").read_text() == "mine"


def test_inspect_finds_every_channel_of_the_example(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["usvlearn"])
    assert main(["example", "logs", "--minutes", "4"]) == 0
    assert main(["inspect", "logs"]) == 0
    written = (tmp_path / "my_boat.yaml").read_text()
    for line in ("name: DESIRED_THRUST_L", "name: DESIRED_THRUST_R", "name: NAV_HEADING", "unit: deg", "span: 100.0"):
        assert line in written
