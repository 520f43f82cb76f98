"""The data check before a run: what the terminal and results.json say, strict, off, and in a sweep."""

import numpy as np
import pytest

import usvlearn
from tests.support import over
from tests.support.commands import QUICK, ran, results, sentence
from tests.support.runs import session
from usvlearn.cli import train
from usvlearn.composition.alignment import CheckedAlignment
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.checks.data_check import CHECKS
from usvlearn.logs.recordings import align_fleet
from usvlearn.report.tables import data_check_table
from usvlearn.simulate.fleet import fleet

TABLE = ["data=csv", "vehicle.surge_max=2.74", "data.channels.heading.unit=rad"]


@pytest.fixture(scope="module")
def knots(tmp_path_factory):
    """The log of a heron whose speed is in knots, as a table."""
    recording = fleet(n=1, hours=0.1, missions=["patrol"], seed=5, aborted_share=0.0)[0]
    at = np.arange(1.0, 350.0, 0.1)
    columns = []
    for name in ("command_left", "command_right", "heading", "surge"):
        channel = recording.channels[name]
        place = np.argsort(channel.time, kind="stable")
        columns.append(channel.value[place][np.maximum(np.searchsorted(channel.time[place], at) - 1, 0)])
    columns[3] = columns[3] * 3600 / 1852
    path = tmp_path_factory.mktemp("logs") / "heron.csv"
    np.savetxt(path, np.column_stack([at, *columns]), delimiter=",", comments="",
               header="time,command_left,command_right,heading,surge")  # fmt: skip
    return path


@pytest.mark.thorough
def test_a_warning_is_shown_and_saved_and_survives_a_resume(knots, tmp_path):
    given = [*TABLE, *QUICK[1:], f"data.path={knots}", f"hydra.run.dir={tmp_path}/run"]
    done = ran(*given, folder=tmp_path, COLUMNS="80")
    shown = done.stdout[: done.stdout.index("learning from the start")]
    assert "Data check" in shown and "set data.channels.surge.unit=knots" in shown
    assert all(len(line) <= 80 for line in shown.splitlines())
    (finding,) = results(tmp_path / "run")["data_check"]
    assert finding["about"] == "surge" and finding["severity"] == "warning" and "knots" in finding["key"]
    assert set(finding) == {"boat", "about", "kind", "found", "expected", "key", "severity"}
    ran(*given, "resume=latest", folder=tmp_path)
    assert results(tmp_path / "run")["data_check"] == [finding]


@pytest.mark.thorough
def test_strict_refuses_and_writes_nothing(knots, tmp_path, monkeypatch, capsys):
    given = [*TABLE, f"data.path={knots}", f"hydra.run.dir={tmp_path}/run", "check=strict"]
    error = sentence(train.main, given, monkeypatch, capsys)
    assert "check=strict: found 1 warning" in error and "set data.channels.surge.unit=knots" in error
    left = [path.name for path in (tmp_path / "run").rglob("*") if ".hydra" not in path.parts]
    assert left == [] or left == [".hydra"]
    tuned = sentence(train.main, [*given, "grid=aid"], monkeypatch, capsys)
    assert "check=strict: found 1 warning" in tuned


@pytest.mark.thorough
def test_the_jobs_of_a_sweep_are_quiet_and_keep_their_findings(knots, tmp_path):
    given = [*TABLE, *QUICK[1:], f"data.path={knots}", "estimators.aid.gain=1,2", f"hydra.sweep.dir={tmp_path}/sweep"]
    done = ran("-m", *given, folder=tmp_path)
    assert "Data check" not in done.stdout and "data check" not in done.stdout
    for job in ("0", "1"):
        assert [each["kind"] for each in results(tmp_path / "sweep" / job)["data_check"]] == ["speed scale"]


@pytest.mark.thorough
def test_read_keeps_and_prints_the_findings(knots):
    how = {"channels": {"heading": {"unit": "rad"}}, "surge_max": 2.74}
    logs = usvlearn.read(knots, **how)
    (finding,) = logs.findings
    assert finding.kind == "speed scale" and "Data check" in repr(logs) and finding.key.split()[0] in repr(logs)
    clean = usvlearn.read(knots, **{**how, "channels": {"heading": {"unit": "rad"}, "surge": {"unit": "knots"}}})
    assert clean.findings == () and "Data check" not in repr(clean)
    assert usvlearn.read(knots, **how, check="off").findings == ()
    with pytest.raises(LogFormatError, match=r"check=strict: found 1 warning"):
        usvlearn.read(knots, **how, check="strict")
    with pytest.raises(ConfigError, match="check: found 'loud', expected one of warn, strict, off"):
        usvlearn.read(knots, **how, check="loud")


def test_logs_that_cannot_be_aligned_are_explained():
    recordings = fleet(n=1, hours=0.1)
    pulses = [
        one._replace(
            channels={
                name: each._replace(value=1500 + 400 * each.value) if name.startswith("command") else each
                for name, each in one.channels.items()
            }
        )
        for one in recordings
    ]
    with pytest.raises(LogFormatError, match=r"measured steps.*data check: .*command_left\.zero=1500") as error:
        CheckedAlignment({})(pulses, dt=0.4)
    assert isinstance(error.value.__cause__, LogFormatError)
    with pytest.raises(LogFormatError, match="expected at least 3") as error:
        CheckedAlignment({"check": "off"})(pulses, dt=0.4)
    assert "data check" not in str(error.value)


@over("settings", ({}, {"check": None}, {"check": "warn"}))
def test_settings_of_older_runs_are_checked(settings):
    align = CheckedAlignment(settings)
    assert align.json is None
    align(fleet(n=1, hours=0.1), dt=0.4)
    assert align.json == []


def test_a_run_without_a_check_says_nothing_of_it(tmp_path):
    aligned = align_fleet(fleet(n=2, hours=0.02), dt=0.4)
    folder = session(tmp_path / "run", aligned)
    assert "data_check" not in folder.finish(0.0)


def test_equal_findings_of_several_boats_are_one_row(capsys):
    from rich.console import Console

    each = {
        "about": "surge",
        "kind": "speed scale",
        "found": "5 m/s",
        "expected": "3",
        "key": "a=1",
        "severity": "note",
    }
    table = data_check_table([{**each, "boat": boat} for boat in ("a", "b", "c")], len(CHECKS))
    Console(width=80).print(table)
    assert "a and 2 more, surge: 5 m/s; expected: 3" in capsys.readouterr().out
