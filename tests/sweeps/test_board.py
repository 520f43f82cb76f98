"""The page of a sweep in TensorBoard: its columns, a row per job, failed jobs, learning curves."""

import pytest
from tensorboard.plugins.hparams.api_pb2 import STATUS_FAILURE, STATUS_SUCCESS
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from tests.support.boards import boards, steps, texts, values
from tests.support.commands import hparams
from usvlearn.display.event_file import TensorBoardWriter
from usvlearn.errors import ConfigError
from usvlearn.evaluation.measure import Measure
from usvlearn.evaluation.ranking import scored
from usvlearn.runs.tensorboard.board_tags import MAE
from usvlearn.sweeps.board import MOST_KEYS, MOST_POINTS, REST, job_names, write_board
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.standings import standings


def job(folder, number, settings, mae=None, by="rnn", **more) -> Job:
    """A job of one boat; without an error it failed."""
    if mae is None:
        return Job(folder / f"{number}", settings, {"error": "bad rate"})
    row = {
        "rnn": {"mae": mae, "skill": 1 - mae, "coverage": 0.9},
        "ensemble": {"mae": 0.02, "skill": 0.5, "coverage": 0.9},
    }
    near = {"ensemble": {"10": {"mae": 0.05}, "30": {"mae": 0.1}}}
    results = {"boats": {"heron": row}, "forecast": {"heron": near}, "output": "ensemble", "seconds": 2.0, **more}
    return Job(folder / f"{number}", settings, scored(results, Measure(by)))


def columns(board):
    """Titles of the settings and of the results, and the domain of each setting."""
    content = boards(board)["."].SummaryMetadata("_hparams_/experiment").plugin_data.content
    found = HParamsPluginData.FromString(content).experiment
    domains = {each.name: list(each.domain_discrete.values) for each in found.hparam_infos}
    assert all(each.differs for each in found.hparam_infos)
    return {key: [getattr(value, value.WhichOneof("kind")) for value in domain] for key, domain in domains.items()}, {
        each.display_name: each.name.tag for each in found.metric_infos
    }


@pytest.fixture
def sweep(tmp_path):
    keys = ("estimators.rnn.neurons", "seed", "align.dt")
    rows = [("4", "0", "0.4"), ("4", "1", "0.4"), ("20", "0", "0.4"), ("20", "1", "0.4")]
    maes = [0.04, 0.05, 0.03, None]
    more = [
        {"free": {"heron": {"rnn": 0.1 + mae}}, "network": {"heron": {"rnn": {"contracting": True, "rate": 0.9 + mae}}}}
        if mae
        else {}
        for mae in maes
    ]
    return [
        job(tmp_path, k, dict(zip(keys, row, strict=True)), mae, **each)
        for k, (row, mae, each) in enumerate(zip(rows, maes, more, strict=True))
    ]


def test_columns_are_the_swept_keys_and_the_results_in_order(sweep, tmp_path):
    write_board(tmp_path / "board", tmp_path, sweep)
    settings, results = columns(tmp_path / "board")
    assert settings == {"estimators.rnn.neurons": [4.0, 20.0], "seed": [0.0, 1.0]}
    assert list(results) == [
        "objective: rnn.mae (m/s)", "skill", "MAE free (m/s)", "contraction rate",
        "MAE 10 s ahead of ensemble (m/s)", "coverage of 90 %", "seconds",
    ]  # fmt: skip  # those that are the same for all jobs come last
    rows = hparams(tmp_path / "board")
    assert len(rows) == len(sweep)
    by_number = {name.split()[0]: row for name, row in rows.items()}
    assert "2 rnn.neurons=20 seed=0" in rows
    assert by_number["1"][0] == {"estimators.rnn.neurons": 4.0, "seed": 1.0}
    numbers = by_number["1"][1]
    assert numbers[results["objective: rnn.mae (m/s)"]] == pytest.approx(0.05)
    assert numbers[results["MAE free (m/s)"]] == pytest.approx(0.15)
    assert numbers[results["contraction rate"]] == pytest.approx(0.95)
    assert numbers[results["MAE 10 s ahead of ensemble (m/s)"]] == pytest.approx(0.05)  # the network makes no forecasts


def test_a_job_that_failed_has_a_row_and_its_reason(sweep, tmp_path):
    write_board(tmp_path / "board", tmp_path, sweep)
    read = boards(tmp_path / "board")
    states = {}
    for name, events in read.items():
        if name != ".":
            content = events.SummaryMetadata("_hparams_/session_end_info").plugin_data.content
            states[name.split()[0]] = HParamsPluginData.FromString(content).session_end_info.status
    assert states == {"0": STATUS_SUCCESS, "1": STATUS_SUCCESS, "2": STATUS_SUCCESS, "3": STATUS_FAILURE}
    assert texts(read["."]) == {"failed jobs": "- rnn.neurons=20 seed=1: bad rate"}
    assert list(read)[:2] == ["0 rnn.neurons=4 seed=0", "1 rnn.neurons=4 seed=1"]  # colours in the order of the jobs


def test_an_objective_of_its_own_has_a_column(tmp_path):
    jobs = [job(tmp_path, k, {"estimators.rnn.rate": rate}, 0.1 * (k + 1)) for k, rate in enumerate(("1e-3", "fast"))]
    jobs = [
        each._replace(results={**each.results, "objective": 0.5 - k, "measure": "rnn.free"})
        for k, each in enumerate(jobs)
    ]
    write_board(tmp_path / "board", tmp_path, jobs)
    settings, results = columns(tmp_path / "board")
    assert settings == {"estimators.rnn.rate": ["1e-3", "fast"]}  # text, because not all are numbers
    assert list(results)[:3] == ["objective: rnn.free", "MAE (m/s)", "skill"]


def test_rows_are_in_the_order_of_the_jobs(tmp_path):
    jobs = [job(tmp_path, k, {"align.dt": f"0.{k + 1}"}, 0.1) for k in range(11)]
    names = job_names(tmp_path, jobs, ["align.dt"])
    assert names == sorted(names) and names[2] == "02 align.dt=0.3"


def test_nothing_that_differs_is_hidden(tmp_path):
    """The page shows five settings at first."""
    keys = [f"data.key{k}" for k in range(7)]
    jobs = [job(tmp_path, k, {key: f"{k}" for key in keys}, 0.1) for k in range(2)]
    write_board(tmp_path / "board", tmp_path, jobs)
    settings, _ = columns(tmp_path / "board")
    assert list(settings) == [*keys[: MOST_KEYS - 1], REST] and len(settings) == MOST_KEYS
    assert settings[REST] == [" ".join(f"{key}={k}" for key in keys[MOST_KEYS - 1 :]) for k in range(2)]


def test_learning_curves_are_copied_and_thinned(sweep, tmp_path):
    with TensorBoardWriter(tmp_path / "0" / "tensorboard" / "rnn.neurons=4") as writer:
        for step in range(1000):
            writer.scalars({f"1 overview/{MAE}": step, "1 overview/skill": 0.0}, step, "heron/rnn")
            writer.scalars({f"1 overview/{MAE}": -1.0}, step, "heron/ensemble")
    write_board(tmp_path / "board", tmp_path, sweep)
    read = boards(tmp_path / "board")
    events, tag = read["0 rnn.neurons=4 seed=0"], f"1 overview/{MAE}"
    assert values(events, tag) == steps(events, tag) and steps(events, tag)[0] == 0 and steps(events, tag)[-1] == 999
    assert len(steps(events, tag)) <= MOST_POINTS
    assert tag not in read["1 rnn.neurons=4 seed=1"].Tags()["scalars"]


def test_damaged_event_files_leave_the_rest(sweep, tmp_path):
    folder = tmp_path / "0" / "tensorboard" / "heron" / "rnn"
    folder.mkdir(parents=True)
    (folder / "events.out.tfevents.0000000001").write_bytes(b"nonsense" * 9)
    write_board(tmp_path / "board", tmp_path, sweep, figures={"leaderboard": b"\x89PNG" + bytes(30)})
    assert len(hparams(tmp_path / "board")) == 4
    assert boards(tmp_path / "board")["."].Tags()["images"] == ["leaderboard"]
    with pytest.raises(ConfigError, match="link"):
        (tmp_path / "link").symlink_to(tmp_path)
        write_board(tmp_path / "link", tmp_path, sweep)


def test_settings_have_rows_before_those_of_their_jobs(sweep, tmp_path):
    """The best first, with means over the seeds that finished, and a mean learning curve."""
    for each, level in zip(sweep, (0.4, 0.6, 0.3, 0.9), strict=True):
        with TensorBoardWriter(each.folder / "tensorboard" / "heron" / "rnn") as writer:
            for step in (10, 20):
                writer.scalars({f"1 overview/{MAE}": level}, step)
    write_board(tmp_path / "board", tmp_path, sweep, standings(sweep, Measure("rnn"), {}))
    rows = hparams(tmp_path / "board")
    names = sorted(rows)
    assert names[:2] == ["+mean 1 rnn.neurons=4", "+mean 2 rnn.neurons=20"] and len(names) == 6
    settings, numbers = rows[names[0]]
    assert settings == {"row": "mean", "estimators.rnn.neurons": 4.0}
    assert numbers["8 results/1 objective"] == pytest.approx(0.045)
    assert rows[names[1]][1]["8 results/1 objective"] == pytest.approx(0.03)  # of the one that finished
    assert rows[names[2]][0]["row"] == "job"
    read = boards(tmp_path / "board")
    assert steps(read[names[0]], f"1 overview/{MAE}") == [10, 20]
    assert values(read[names[0]], f"1 overview/{MAE}") == pytest.approx([0.5, 0.5])
