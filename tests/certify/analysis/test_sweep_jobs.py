"""python -m certify SWEEP: a row for each job, from folders made by hand whose rates and errors are known."""

import itertools
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from certify.__main__ import main
from certify.analysis.sweep_jobs import jobs
from certify.display.sweep_figure import sweep_figure
from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from tests.support import few
from tests.support.certify_command import told
from usvlearn.core.checkpoint import save
from usvlearn.runs.layout import CHECKPOINTS, save_results
from usvlearn.sweeps.jobs import run_job

BOATS = ("anna", "bert")


def saved(file: Path, rate: float, member: str = "rnn") -> None:
    """A checkpoint of one neuron whose exact rate is given; `simple` holds below 1/8, `gershgorin` below 1/4."""
    w1 = 0.5 if rate < 0.25 else 1.0
    network = ShallowWeights(np.array([rate / w1]), np.array([w1]), np.zeros((1, 4)), np.zeros(1))
    save(file, {"members": {member: {"weights": network}, "aid": {"gain": np.ones(1)}}}, boat=file.parent.name)


def job(folder: Path, overrides, rates=(0.5, 0.5), mae=0.1, free=None, member="rnn") -> Path:
    """A finished job of two boats; `free` is the error of the first, the second has twice as much."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "job.json").write_text(json.dumps({"settings": "0" * 64, "overrides": list(overrides)}))
    results = {"boats": {boat: {member: {"mae": mae, "skill": 0.5}} for boat in BOATS}, "objective": mae}
    if free is not None:
        results["free"] = {boat: {member: factor * free} for boat, factor in zip(BOATS, (1, 2), strict=True)}
    (folder / "results.json").write_text(json.dumps(results))
    for boat, rate in zip(BOATS, rates, strict=True):
        saved(
            folder / "checkpoints" / boat / "00000_0000750.safetensors", 4.0, member
        )  # an earlier one, not contracting
        saved(folder / "checkpoints" / boat / "00001_0000020.safetensors", rate, member)
    return folder


@pytest.fixture
def sweep(tmp_path):
    """Four jobs: by rate 1/16, 3/8, 3/4 and 2; the most accurate is the last one, which is not contracting."""
    for k, (condition, rate, free) in enumerate(
        [("simple", 0.0625, 0.5), ("lmi", 0.375, 0.25), ("tight", 0.75, 0.125), ("none", 2.0, 0.0625)]
    ):
        job(tmp_path / str(k), [f"estimators.rnn.condition={condition}", "data.hours=1"], (rate / 2, rate), free=free)
    (tmp_path / "leaderboard").mkdir()
    (tmp_path / "leaderboard.csv").write_text("job\n0\n")
    return tmp_path


def by_job(rows) -> dict[str, dict]:
    return {row["jobs"][0]: row for row in rows}


def test_a_row_of_each_job_with_its_last_sets_the_certified_first(sweep, capsys):
    code, rows = told(capsys, sweep)
    assert code == 1 and [row["jobs"] for row in rows] == [["2"], ["1"], ["0"], ["3"]]
    assert [row["rate"] for row in rows] == [0.75, 0.375, 0.0625, 2.0] and [row["sets"] for row in rows] == [2] * 4
    assert [row["free"] for row in rows] == pytest.approx([1.5 * x for x in (0.125, 0.25, 0.5, 0.0625)])
    assert rows[0]["settings"] == {"estimators.rnn.condition": "tight"} and rows[0]["mae"] == pytest.approx(0.1)
    assert [row["certified"]["tight"] for row in rows] == [2, 2, 2, 0]
    assert [row["certified"]["lmi"] for row in rows] == [1, 2, 2, 0]
    assert [Path(path).parts[-4:] for path in rows[0]["paths"]] == [
        ("2", "checkpoints", boat, "00001_0000020.safetensors")[-4:] for boat in BOATS
    ]


@pytest.mark.parametrize(
    ("condition", "held", "code"), [("tight", {"0", "1", "2"}, 1), ("lmi", {"0", "1"}, 1), ("simple", {"0"}, 1)]
)
def test_the_condition_orders_the_rows_and_decides_the_code(sweep, capsys, condition, held, code):
    found, rows = told(capsys, sweep, "--condition", condition)
    assert found == code and {row["jobs"][0] for row in rows if row["holds"]} == held
    assert [row["holds"] for row in rows] == sorted((row["holds"] for row in rows), reverse=True)


def test_the_code_is_0_if_all_are_certified(sweep, capsys):
    job(sweep / "3", ["estimators.rnn.condition=none", "data.hours=1"], (0.5, 0.25), free=1.0)
    code, rows = told(capsys, sweep)
    assert code == 0 and [row["jobs"] for row in rows] == [["2"], ["1"], ["0"], ["3"]]
    assert told(capsys, sweep, "--all")[0] == 1


def test_all_sets_are_judged_when_asked(sweep, capsys):
    _, rows = told(capsys, sweep, "--all")
    assert [row["sets"] for row in rows] == [4] * 4 and {row["rate"] for row in rows} == {4.0}
    assert [row["jobs"] for row in rows] == [["3"], ["2"], ["1"], ["0"]]  # none is certified: by error
    main([str(sweep), "--all"])
    assert "the largest of all checkpoints" in capsys.readouterr().out


def test_a_job_that_a_sweep_has_run_is_read(tmp_path, capsys):
    """`usvlearn` writes what is read here."""

    def work(resume):
        saved(tmp_path / "0" / CHECKPOINTS / "anna" / "00000_0000750.safetensors", 0.25)
        save_results(
            tmp_path / "0", {"boats": {"anna": {"rnn": {"mae": 0.1}}}, "free": {"anna": {"rnn": float("nan")}}}
        )
        return 0.1

    run_job(tmp_path / "0", {"dt": 0.4}, ["dt=0.4"], work)
    run_job(tmp_path / "1", {"dt": 0.5}, ["dt=0.5"], lambda resume: 1 / 0)
    code, (row, failed) = told(capsys, tmp_path)
    assert (row["rate"], row["mae"], row["free"], row["settings"]) == (0.25, 0.1, None, {"dt": "0.4"})
    assert code == 1 and failed["jobs"] == ["1"] and failed["error"].startswith("failed: ZeroDivisionError")


def test_jobs_given_apart_are_shown_set_by_set(sweep, capsys):
    for paths in ([sweep / "0"], [sweep / "0", sweep / "1"], [sweep / "[0-1]"], [sweep, sweep / "0"]):
        _, rows = told(capsys, *paths)
        assert all("path" in row and "jobs" not in row for row in rows)
    single = job(sweep.parent / "run", ["data.hours=1"])
    (single / "job.json").unlink()  # as train.py without a sweep leaves it
    assert all("path" in row for row in told(capsys, single)[1])
    assert jobs([single]) == [] and [each.name for each in jobs([sweep])] == ["0", "1", "2", "3"]


def test_several_sweeps_are_one_table(sweep, capsys, monkeypatch):
    monkeypatch.chdir(sweep.parent)
    job(Path("other/0"), ["estimators.rnn.condition=tight", "data.hours=2"], free=0.01)
    _, rows = told(capsys, sweep.name, "other")
    assert len(rows) == 5 and rows[0]["jobs"] == ["other/0"]
    assert rows[0]["settings"] == {"estimators.rnn.condition": "tight", "data.hours": "2"}


def test_seeds_are_one_row_with_mean_and_deviation(tmp_path, capsys):
    for k in range(12):  # numbered so that 10 and 11 come after 9
        rate, error = (0.25, 0.5)[k < 6], 0.1 + 0.1 * (k % 3) + (0.5 if k < 6 else 0)
        job(
            tmp_path / str(k),
            [f"estimators.rnn.rate={k // 3}", f"seed={k % 3}"],
            (rate, rate + k % 3 / 8),
            error,
            error,
        )
    code, rows = told(capsys, tmp_path)
    assert code == 0 and [row["jobs"] for row in rows] == [[str(k + j) for j in range(3)] for k in (6, 9, 0, 3)]
    assert rows[0]["settings"] == {"estimators.rnn.rate": "2"} and rows[0]["sets"] == 6
    assert rows[0]["rate"] == 0.5 and rows[0]["rates"] == [0.25, 0.375, 0.5]
    assert rows[0]["mae"] == pytest.approx(0.2) and rows[0]["mae_deviation"] == pytest.approx(0.1)
    assert rows[0]["free"] == pytest.approx(0.3) and rows[0]["free_deviation"] == pytest.approx(0.15)
    assert rows[0]["certified"]["lmi"] == 5  # of the last seed, the second boat has 2K = 1
    main([str(tmp_path)])
    text = capsys.readouterr().out
    assert "9–11" in text and "0.2000±0.1000" in text and "seeds" in text and "5/6" in text


def test_a_sweep_over_seeds_alone_is_one_row_without_settings(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for k in range(3):
        job(tmp_path / str(k), [f"seed={k}", "data.hours=1"], mae=0.1)
    assert main([str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^0–2 +– +0.1000±0.0000 +0.5 ", text, re.M) and "1 of 1 rows certified" in text


@pytest.mark.parametrize(("keys", "seeds"), few(itertools.product([1, 2, 6], [1, 3]), [(1, 3), (6, 1)], "thorough"))
def test_the_table_fits_80_columns(tmp_path, capsys, monkeypatch, keys, seeds):
    monkeypatch.setenv("COLUMNS", "80")
    for k in range(4 * seeds):
        settings = [f"estimators.rnn.a_long_name_{j}=value_{k // seeds}_{j}" for j in range(keys)]
        job(tmp_path / str(k), [*settings, f"seed={k % seeds}"], (0.25, 1 - 2**-30), 0.1, 0.1 + k)
    main([str(tmp_path), "--box", "--seconds", "0.1"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    text = " ".join(lines)
    for k in range(4):
        assert f"value_{k}_{keys - 1}" in text
    assert "a_long_name_0" in text and "gersh." in text and "K on box" in text
    assert "0.9999999991" in text  # rounded up, and not to 1


def test_jobs_that_failed_or_have_not_finished_are_named_below(sweep, capsys):
    job(sweep / "3", ["estimators.rnn.condition=tight"], free=1.0)
    (sweep / "3/results.json").write_text(json.dumps({"error": "data: found no \x1b[31mlogs"}))
    (sweep / "10").mkdir()
    (sweep / "10/job.json").write_text(json.dumps({"settings": "", "overrides": ["estimators.rnn.condition=late"]}))
    (sweep / "2/results.json").write_text(json.dumps({"partial": {}}))
    assert main([str(sweep)]) == 1
    text = capsys.readouterr().out
    assert "job 3 (condition=tight" in text and "failed: data: found no \\x1b[31mlogs" in text and "\x1b" not in text
    assert "job 10 (condition=late" in text and "not finished, judged by the checkpoints saved so far: job 2" in text
    assert "3 of 3 rows certified" in text
    code, rows = told(capsys, sweep)
    assert code == 1 and [row["jobs"] for row in rows] == [["1"], ["0"], ["2"], ["3"], ["10"]]  # without error last
    assert rows[2]["free"] is rows[2]["mae"] is None and rows[2]["unfinished"] == ["2"]
    assert rows[3]["error"].startswith("failed") and rows[4]["error"] == "not finished"


def test_a_sweep_without_a_parameter_set_is_bad_input(tmp_path, capsys):
    for k in range(2):
        (tmp_path / str(k)).mkdir()
        (tmp_path / str(k) / "job.json").write_text('{"overrides": []}')
        (tmp_path / str(k) / "results.json").write_text('{"error": "no data"}')
    assert main([str(tmp_path)]) == 2
    assert "none of its 2 jobs holds a checkpoint (job 0: failed: no data)" in capsys.readouterr().err


DAMAGED = {
    "no JSON": ("results.json", "{"),
    "a list": ("results.json", "[1]"),
    "deep": ("results.json", "[" * 100_000),
    "no tables": ("results.json", '{"boats": 3}'),
    "no errors": ("results.json", '{"boats": {"anna": {"rnn": {"mae": "low"}}}}'),
    "no rows": ("results.json", '{"boats": {"anna": {"rnn": 0.1}}}'),
    "infinite": ("results.json", '{"boats": {}, "free": {"anna": {"rnn": Infinity}}}'),
    "negative": ("results.json", '{"boats": {}, "free": {"anna": {"rnn": -1}}}'),
    "true": ("results.json", '{"boats": {}, "free": {"anna": {"rnn": true}}}'),
    "beyond floats": ("results.json", '{"boats": {}, "free": {"anna": {"rnn": 1%s}}}' % ("0" * 400)),
    "no text": ("results.json", b"\xff\xfe"),
    "no settings": ("job.json", '{"overrides": "dt=1"}'),
    "numbers": ("job.json", '{"overrides": [1]}'),
    "empty": ("job.json", ""),
    "network": ("checkpoints/anna/00001_0000020.safetensors", "hello"),
}


@pytest.mark.parametrize(("file", "content"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_is_one_sentence_and_the_others_are_shown(sweep, capsys, file, content):
    (sweep / "1" / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert main([str(sweep), "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and captured.err.startswith(f"error: {sweep / '1' / file}: ")
    rows = by_job(json.loads(captured.out))
    assert set(rows) == {"0", "1", "2", "3"} and rows["2"]["rate"] == 0.75 and rows["1"]["rate"] == 0.375
    assert rows["2"]["settings"] == {"estimators.rnn.condition": "tight"}
    assert main([str(sweep)]) == 2


def test_no_link_is_followed_out_of_the_folder(sweep, capsys, tmp_path_factory):
    outside = job(tmp_path_factory.mktemp("outside") / "7", ["estimators.rnn.condition=secret"], (0.5, 0.5))
    (sweep / "7").symlink_to(outside)
    assert [each.name for each in jobs([sweep])] == ["0", "1", "2", "3"]
    (sweep / "1/results.json").unlink()
    (sweep / "1/results.json").symlink_to(outside / "results.json")
    (sweep / "0/job.json").unlink()
    os.mkfifo(sweep / "0/job.json")
    assert main([str(sweep), "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("link or no file") == 2 == captured.err.count("\n") and "secret" not in captured.out
    assert by_job(json.loads(captured.out))["1"]["mae"] is None


def test_an_error_that_one_boat_lacks_is_not_averaged_over_the_others(sweep, capsys):
    results = json.loads((sweep / "2/results.json").read_text())
    results["free"]["anna"]["rnn"] = None  # diverged
    (sweep / "2/results.json").write_text(json.dumps(results))
    del (results := json.loads((sweep / "1/results.json").read_text()))["free"]["bert"]  # too few runs
    (sweep / "1/results.json").write_text(json.dumps(results))
    rows = by_job(told(capsys, sweep)[1])
    assert rows["2"]["free"] is None and rows["1"]["free"] == pytest.approx(0.25)


def test_every_network_has_its_row_and_its_own_error(tmp_path, capsys):
    for k in range(2):
        folder = job(tmp_path / str(k), [f"dt={k}"], (0.5, 0.25), mae=0.1 + k)
        for boat in BOATS:
            weights = [ShallowWeights(np.array([x]), np.ones(1), np.zeros((1, 4)), np.zeros(1)) for x in (0.5, 0.75)]
            both = {"rnn": {"weights": weights[0]}, "rnn_replay": {"weights": weights[1]}}
            save(folder / "checkpoints" / boat / "00002_0000001.safetensors", {"members": both}, boat=boat)
    _, rows = told(capsys, tmp_path)
    found = {(row["jobs"][0], row["network"]): (row["rate"], row["mae"]) for row in rows}
    assert found == {
        ("0", "rnn"): (0.5, pytest.approx(0.1)), ("1", "rnn"): (0.5, pytest.approx(1.1)),
        ("0", "rnn_replay"): (0.75, None), ("1", "rnn_replay"): (0.75, None),
    }  # fmt: skip
    main([str(tmp_path)])
    assert "network" in capsys.readouterr().out


@pytest.mark.parametrize("option", [["--lmi"], ["--dt", "0.4"], ["--input", "0,0,0,0"], ["--headings"]])
def test_options_of_single_sets_are_refused(sweep, capsys, option):
    assert main([str(sweep), *option]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {option[0]}: is about single checkpoints") and error.count("\n") == 1


def test_certificates_of_a_sweep_are_of_the_judged_sets(sweep, capsys):
    assert main([str(sweep), "--certificate", str(sweep / "proofs")]) == 1
    proofs = sorted((sweep / "proofs").iterdir())
    assert len(proofs) == 6 and all("00001_0000020" in proof.name for proof in proofs)
    capsys.readouterr()
    assert main(["--verify", *map(str, proofs)]) == 0


def rows_of(capsys, folder) -> list[dict]:
    return told(capsys, folder)[1]


def marks(axes) -> dict[str, set[tuple[float, float]]]:
    """The points by their label in the legend."""
    return {
        line.get_label(): set(zip(*map(tuple, line.get_data()), strict=True))
        for line in axes.lines
        if line.get_marker() not in (None, "None", "") and not line.get_label().startswith("_")
    }


def test_the_figure_has_a_mark_for_each_job_by_verdict(sweep, capsys):
    pytest.importorskip("matplotlib")
    rows = by_job(rows_of(capsys, sweep))
    axes = sweep_figure(list(rows.values())).axes[0]
    place = {name: (min(row["rate"], axes.get_xlim()[1] / 1.02), row["free"]) for name, row in rows.items()}
    assert marks(axes) == {
        "simple: 1": {place["0"]}, "lmi: 1": {place["1"]}, "tight: 1": {place["2"]},
        "no condition: 1": {place["3"]},
    }  # fmt: skip
    assert axes.get_ylabel() == "MAE of open-loop simulations, m/s" and axes.get_yscale() == "log"
    limits = {
        line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1 and len(line.get_xdata()) == 2
    }
    assert {0.25, 0.5, 1.0} <= limits
    texts = {text.get_text() for text in axes.texts}
    assert {"0", "1", "2", "3"} <= texts and any("at the right edge: 1" in text for text in texts)
    assert all(text.get_fontsize() >= 8 for text in [*axes.texts, *axes.get_legend().get_texts()])
    assert axes.get_legend().get_window_extent().x0 > axes.get_window_extent().x1  # it covers no mark


def test_the_line_joins_the_jobs_that_no_other_beats(sweep, capsys):
    pytest.importorskip("matplotlib")
    job(sweep / "4", ["estimators.rnn.condition=worse"], (0.5, 0.5), free=2.0)
    axes = sweep_figure(rows_of(capsys, sweep)).axes[0]
    (line,) = [line for line in axes.lines if str(line.get_label()).startswith("least error")]
    joined = list(line.get_xdata())
    assert joined[:3] == [0.0625, 0.375, 0.75] and 0.5 not in joined


def test_the_figure_without_free_runs_shows_the_error_of_one_step(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    for k in range(2):
        job(tmp_path / str(k), [f"dt={k}"], (0.5, 0.25), mae=0.1 + k / 100)
    rows = rows_of(capsys, tmp_path)
    axes = sweep_figure(rows).axes[0]
    assert axes.get_ylabel() == "MAE one step ahead, m/s" and axes.get_yscale() == "linear"
    for row in rows:
        row["mae"] = None
    with pytest.raises(CertifyError, match="no errors"):
        sweep_figure(rows)


def test_the_picture_of_a_sweep_is_written(sweep, capsys):
    pytest.importorskip("matplotlib")
    job(sweep / "4", ["estimators.rnn.condition=$\\frac$ a", "x=1"], (0.5, 0.5), free=0.01)
    assert main([str(sweep), "--plot", str(sweep / "out/sweep.png")]) == 1
    assert (sweep / "out/sweep.png").stat().st_size > 10_000 and "picture: " in capsys.readouterr().out
