"""The page of a sweep in TensorBoard: its columns, a row per setting, failed jobs."""

import pytest
from tensorboard.plugins.hparams.api_pb2 import STATUS_FAILURE, STATUS_SUCCESS
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from tests.support.boards import boards, texts
from tests.support.commands import hparams
from usvlearn.errors import ConfigError
from usvlearn.evaluation.objective import Measure, scored
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.ranking import standings
from usvlearn.sweeps.tensorboard import MOST_KEYS, REST, write_board


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
    experiment = HParamsPluginData.FromString(content).experiment
    domains = {each.name: list(each.domain_discrete.values) for each in experiment.hparam_infos}
    assert all(each.differs for each in experiment.hparam_infos)
    return {key: [getattr(value, value.WhichOneof("kind")) for value in domain] for key, domain in domains.items()}, {
        each.display_name: each.name.tag for each in experiment.metric_infos
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


def write(board, jobs, **more):
    write_board(board, standings(jobs, Measure("rnn"), {}), **more)


def test_columns_are_the_swept_keys_and_the_results_in_order(sweep, tmp_path):
    """A row has the means over the seeds that finished; the best comes first."""
    write(tmp_path / "board", sweep)
    settings, results = columns(tmp_path / "board")
    assert settings == {"estimators.rnn.neurons": [4.0, 20.0]}
    assert list(results) == [
        "objective: rnn.mae (m/s)", "skill", "MAE free (m/s)", "contraction rate",
        "MAE 10 s ahead of ensemble (m/s)", "coverage of 90 %", "seconds",
    ]  # fmt: skip  # those that are the same for all settings come last
    rows = hparams(tmp_path / "board")
    assert sorted(rows) == ["1 rnn.neurons=4", "2 rnn.neurons=20"]
    for name, mae, rate in (("1 rnn.neurons=4", 0.045, 0.95), ("2 rnn.neurons=20", 0.03, 0.93)):
        numbers = rows[name][1]
        assert numbers[results["objective: rnn.mae (m/s)"]] == pytest.approx(mae)
        assert numbers[results["MAE free (m/s)"]] == pytest.approx(0.1 + mae)
        assert numbers[results["contraction rate"]] == pytest.approx(rate)  # the largest
        assert numbers[results["MAE 10 s ahead of ensemble (m/s)"]] == pytest.approx(0.05)  # it makes no forecasts


def test_a_setting_that_failed_has_a_row_and_the_reasons(sweep, tmp_path):
    sweep[2] = job(tmp_path, 2, sweep[2].settings)
    write(tmp_path / "board", sweep)
    read = boards(tmp_path / "board")
    states = {}
    for name in list(read)[:2]:
        content = read[name].SummaryMetadata("_hparams_/session_end_info").plugin_data.content
        states[name] = HParamsPluginData.FromString(content).session_end_info.status
    assert states == {"1 rnn.neurons=4": STATUS_SUCCESS, "2 rnn.neurons=20": STATUS_FAILURE}
    reasons = "- rnn.neurons=20 seed=0 align.dt=0.4: bad rate\n- rnn.neurons=20 seed=1 align.dt=0.4: bad rate"
    assert texts(read["."]) == {"failed jobs": reasons}


def test_an_objective_of_its_own_has_a_column(tmp_path):
    jobs = [job(tmp_path, k, {"estimators.rnn.rate": rate}, 0.1 * (k + 1)) for k, rate in enumerate(("1e-3", "fast"))]
    jobs = [
        each._replace(results={**each.results, "objective": 0.5 - k, "measure": "rnn.free"})
        for k, each in enumerate(jobs)
    ]
    write(tmp_path / "board", jobs)
    settings, results = columns(tmp_path / "board")
    assert settings == {"estimators.rnn.rate": ["1e-3", "fast"]}  # text, because not all are numbers
    assert list(results)[:3] == ["objective: rnn.free", "MAE (m/s)", "skill"]


def test_nothing_that_differs_is_hidden(tmp_path):
    """The page shows five settings at first; TensorBoard sorts the rows by their names."""
    keys = [f"data.key{k}" for k in range(7)]
    jobs = [job(tmp_path, k, {key: f"{k}" for key in keys}, 0.1 + k) for k in range(11)]
    write(tmp_path / "board", jobs)
    settings, _ = columns(tmp_path / "board")
    assert list(settings) == [*keys[: MOST_KEYS - 1], REST] and len(settings) == MOST_KEYS
    assert sorted(settings[REST])[0] == " ".join(f"{key}=0" for key in keys[MOST_KEYS - 1 :])
    assert [name.split()[0] for name in sorted(hparams(tmp_path / "board"))] == [f"{k:02d}" for k in range(1, 12)]


def test_an_earlier_page_is_replaced_and_no_link_is_followed(sweep, tmp_path):
    for _ in range(2):
        write(tmp_path / "board", sweep, figures={"leaderboard": b"\x89PNG" + bytes(30)})
    assert len(hparams(tmp_path / "board")) == 2
    assert len(boards(tmp_path / "board")["."].Images("leaderboard")) == 1
    with pytest.raises(ConfigError, match="link"):
        (tmp_path / "link").symlink_to(tmp_path)
        write(tmp_path / "link", sweep)
