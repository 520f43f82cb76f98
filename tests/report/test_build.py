"""The report: its numbers by hand, its files, its page in a browser, and what bad input is told."""

import csv
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate

from tests.support.commands import run
from tests.support.runs import tools
from usvlearn import AID, Ensemble
from usvlearn.cli.evaluate import main
from usvlearn.core.checkpoint import checkpoints, load
from usvlearn.errors import CheckpointError, ConfigError, MissingExtraError
from usvlearn.logs.recordings import align_fleet
from usvlearn.report.build import known_quantities, read
from usvlearn.report.page import check_report_folder, write_report
from usvlearn.report.sections.parameters import identified_section
from usvlearn.runs.saved import configuration, is_sweep, read_seasons, results, run_folders

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long


@pytest.fixture
def copy(saved, tmp_path) -> Path:
    shutil.copytree(saved, tmp_path / "run")
    return tmp_path / "run"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_every_file_is_there_and_replaced(saved):
    report = saved / "report"
    figures = {path.name for path in (report / "figures").iterdir()}
    names = {"online", "forecast", "crossval", "fleet", "certificates", "equilibria", "residuals",
             "best_minutes_1", "best_minutes_2",
             "identified_heron1", "identified_heron2", "tracks", "tracks_heron1", "tracks_heron2",
             *(f"fit_{kind}_heron{k}" for kind in ("curves", "residuals", "worst") for k in (1, 2))}  # fmt: skip
    assert figures == {f"{name}.svg" for name in names}
    tables = {"online", "online_fleet", "forecast", "crossval", "crossval_fleet", "fleet", "equilibria", "certificates",
              "identified", "cost", "residuals", "tracks", "fit", "fit_sets", "fit_missions"}  # fmt: skip
    assert {path.name for path in (report / "tables").iterdir()} == {f"{name}.csv" for name in tables}
    text = (report / "report.md").read_text()
    assert "The paper found" not in text  # it stands where a study is judged
    assert "- heron1, rnn: open-loop simulations " in text and "The map of the last network of heron1" in text


def test_online_errors_are_those_of_the_run(saved):
    boats_ = json.loads((saved / "results.json").read_text())["boats"]
    lines = rows(saved / "report" / "tables" / "online.csv")
    assert len(lines) == sum(map(len, boats_.values()))
    for row in lines:
        expected = boats_[row["boat"]][row["method"]]
        assert float(row["MAE, m/s"]) == expected["mae"] and int(row["steps"]) == expected["steps"]


def test_methods_are_in_the_order_of_their_errors_and_the_map_is_said(saved):
    for name, column in (("online", "MAE, m/s"), ("crossval", "mean, m/s")):
        lines = rows(saved / "report" / "tables" / f"{name}.csv")
        for boat in ("heron1", "heron2"):
            errors = [float(row[column]) for row in lines if row["boat"] == boat]
            assert errors == sorted(errors)
        fleet = rows(saved / "report" / "tables" / f"{name}_fleet.csv")
        means = [float(value) for row in fleet for key, value in row.items() if "mean over boats" in key]
        assert means == sorted(means) and len(means) == len(fleet)
        for table in (lines, fleet):
            remarks = {row["method"]: row["remark"] for row in table}
            assert (remarks["sift_map"], remarks["average"], remarks["aid"]) == (
                "quasi-static map",
                "with sift_map",
                "",
            )
            assert remarks["persistence"] == "baseline"
            assert name == "online" or remarks["ensemble+"] == remarks["weighted+"] == "sees the speed"
    order = [row["method"] for row in rows(saved / "report" / "tables" / "online_fleet.csv")]
    labels = re.findall(r"<text[^>]*>(\w+)</text>", (saved / "report" / "figures" / "online.svg").read_text())
    shown = [label for label in labels if label in order]
    assert shown[: len(order)] == order  # the first panel's
    (page,) = (saved / "report").glob("report.md")
    assert "- sift_map: a quasi-static map, which predicts the speed from the commands" in page.read_text()


def test_cross_validation_counts_every_other_run(saved):
    lines = rows(saved / "report" / "tables" / "crossval.csv")
    methods = {row["method"] for row in lines}
    assert {"aid", "average", "weighted", "weighted+", "ensemble", "ensemble+"} <= methods
    for boat in ("heron1", "heron2"):
        sets = len(checkpoints(saved / "checkpoints" / boat))
        counts = {int(row["simulations"]) for row in lines if row["boat"] == boat}
        assert counts == {sets}  # two runs: each checkpoint has one other
    arrays = np.load(saved / "report" / "crossval.npz")
    assert arrays["heron1_mae"].shape[1:] == (2, len(methods))


def test_sets_know_their_run_and_their_hours(saved):
    ensemble, seasons = read([saved], tools())
    lengths = json.loads((saved / "runs.json").read_text())["boats"]["heron2"]
    season = seasons[1]
    assert season.boat == "heron2" and not is_sweep(saved)
    for path, index, hours in zip(season.paths, season.saved_in, season.hours, strict=True):
        run_, step = map(int, path.stem.split("_"))
        assert index == run_ and path.parent.name == "heron2"
        assert hours == pytest.approx((sum(length for _, length, _ in lengths[:run_]) + step) * 0.4 / 3600)
    theta = load(season.paths[1])[0]["members.aid.theta"]
    assert np.array_equal(season.state.members["aid"].theta[1].numpy(), theta)
    assert season.others.sum(1).tolist() == [1] * len(season.saved_in)
    for each, (name, length, _) in zip(season.runs, lengths, strict=True):
        assert each.name == name and each.published["predictions"].shape == (length, len(ensemble.names))
    with pytest.raises(CheckpointError, match="does not fit"), pytest.warns(UserWarning, match="expected numbers of"):
        read_seasons([saved], Ensemble({"aid": AID(mass=28.0)}), fleets(saved))


def fleets(folder: Path) -> list:
    cfg = configuration(folder)
    return [align_fleet(instantiate(cfg["data"]), **cfg["align"])]


# What bad input is told: what is done to a copy of the run, and what the sentence says.
def remove_sets(folder: Path) -> None:
    shutil.rmtree(folder / "checkpoints")


def spoil_all_sets(folder: Path) -> None:
    for path in folder.glob("checkpoints/*/*"):
        path.write_bytes(path.read_bytes()[:-9])


def cut_results(folder: Path) -> None:
    (folder / "results.json").write_text((folder / "results.json").read_text()[:200])


def cut_runs(folder: Path) -> None:
    (folder / "runs.json").write_text("{")


@pytest.mark.parametrize(
    ("harm", "sentence"),
    [
        (remove_sets, "has no checkpoints"),
        (spoil_all_sets, "checkpoints can be read"),
        (cut_results, "results.json: is damaged"),
        (cut_runs, "runs.json: is damaged"),
    ],
)
def test_a_damaged_folder_is_told_in_one_sentence(copy, harm, sentence):
    harm(copy)
    done = run(f"runs={copy}", folder=copy.parent, script="evaluate.py")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert re.search(rf"^error: .*{sentence}.*: .+$", done.stderr, re.MULTILINE), done.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "runs is not set: set runs=FOLDER"),
        (("runs=nowhere",), "runs: found no run below 'nowhere'"),
        (("runs={run}", "data=simulated", "data.plant=otter"), "found the boat otter, of which the runs contain no"),
    ],
)
def test_bad_arguments_are_told_in_one_sentence(saved, tmp_path, arguments, sentence):
    done = run(*(a.replace("{run}", str(saved)) for a in arguments), folder=tmp_path, script="evaluate.py")
    assert done.returncode == 2 and sentence in done.stderr and "Traceback" not in done.stderr


def test_one_damaged_set_is_passed_over(copy):
    path = sorted(copy.glob("checkpoints/heron1/*"))[0]
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    with pytest.warns(UserWarning, match="damaged"):
        _, seasons = read([copy], tools())
    sets = checkpoints(copy / "checkpoints" / "heron1")
    assert list(seasons[0].paths) == sets[1:] and len(seasons[0].saved_in) == len(sets) - 1


def test_other_logs_of_a_boat_are_all_other_runs(saved):
    data = {**configuration(saved)["data"], "seed": 77, "hours": 0.05}
    _, seasons = read([saved], tools(), data)
    assert [season.boat for season in seasons] == ["heron1", "heron2"]
    assert all(season.others.all() and not season.runs[0].published for season in seasons)


@pytest.mark.usefixtures("drawn_once")
def test_a_report_on_other_logs_checks_them_says_so_and_stands_beside_that_of_the_run(copy, monkeypatch, capsys):
    given = ["data=simulated", "data.n=2", "data.hours=0.05", "data.seed=77"]
    monkeypatch.setattr("sys.argv", ["evaluate.py", f"runs={copy}", *given])
    main()
    assert "Data check: no findings" in capsys.readouterr().out
    text = (copy / "report_of_other_logs" / "index.html").read_text()
    assert '<p class="note">Judged on other logs than those of the runs' in text


def test_two_folders_of_one_season_are_pooled(copy, saved):
    (copy / "results.json").unlink()
    _, seasons = read([saved, copy], tools())
    assert len(seasons[0].runs) == 2  # the same runs count once
    assert len(seasons[0].saved_in) == 2 * len(checkpoints(saved / "checkpoints" / "heron1"))
    assert seasons[0].hours.max() == pytest.approx(2 * seasons[0].hours[: len(seasons[0].saved_in) // 2].max())


def test_run_folders_are_found_below_and_must_be_there(saved, tmp_path):
    assert run_folders(saved.parent) == [saved] == run_folders(saved)
    with pytest.raises(ConfigError, match="found no run below"):
        run_folders(tmp_path)


def test_a_report_never_takes_the_place_of_something_else(copy):
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    for folder in (copy, copy / "checkpoints"):
        done = run(f"runs={copy}", f"report={folder}", folder=copy.parent, script="evaluate.py")
        assert done.returncode == 2 and "holds something that is no report" in done.stderr
    (copy.parent / "file").write_text("mine")
    done = run(f"runs={copy}", f"report={copy.parent}/file", folder=copy.parent, script="evaluate.py")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "Traceback" not in done.stderr
    assert before == {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}


def test_a_list_of_files_that_names_others_removes_none(tmp_path):
    report, mine = tmp_path / "report", tmp_path / "mine"
    check_report_folder(report)
    mine.write_text("mine")
    (report / "tables" / "old.csv").write_text("old")
    names = ["../mine", "figures/../../mine", str(mine), "figures/..", ".", "", "tables/old.csv"]
    (report / "files.json").write_text(json.dumps(names))
    write_report(report, ["Two"], [])
    assert mine.read_text() == "mine" and not (report / "tables" / "old.csv").exists()
    (report / "tables").rename(tmp_path / "elsewhere")
    (report / "tables").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="tables is a link to another folder"):
        write_report(report, ["Three"], [])


def test_a_report_lists_and_removes_only_its_own_files(tmp_path):
    report = tmp_path / "report"
    write_report(report, ["One"], [])
    for name in ("figures/mine.svg", "tables/mine.csv"):
        (report / name).write_text("mine")
    for _ in range(2):
        write_report(report, ["Again"], [])
    assert [path.read_text() for path in sorted(report.rglob("*mine*"))] == ["mine"] * 2
    assert json.loads((report / "files.json").read_text()) == []


def test_matplotlib_missing_is_told_before_anything_is_simulated(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"usvlearn\[plot\]"):
        check_report_folder(tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_runs_of_several_ensembles_are_not_pooled(copy, saved, tmp_path):
    content = json.loads((copy / "runs.json").read_text())
    (copy / "runs.json").write_text(json.dumps({**content, "ensemble": "another"}))
    shutil.copytree(saved, copy / "below")
    shutil.rmtree(copy / ".hydra"), shutil.rmtree(copy / "below" / ".hydra")
    with pytest.raises(ConfigError, match="runs of several ensembles"):
        is_sweep(copy)


def test_identified_boats_are_drawn_with_their_truth_and_their_sentences(saved):
    ensemble, seasons = read([saved], tools())
    known = known_quantities(results(saved))
    section = identified_section(seasons, ensemble, known)
    assert all(len(drawn.figure.axes) == 3 and "Crosses: truth" in drawn.caption for drawn in section.figures)
    assert len(section.figures) == len(seasons)
    rows = [row for row in section.sheets[0].rows if row[1] == "steady_speed_full"]
    for (boat, _, unit, value, low, high, truth), season in zip(rows, seasons, strict=True):
        assert (boat, unit, truth) == (season.boat, "m/s", known[boat]["steady_speed_full"]) and low <= value <= high
    assert "The intervals hold" in section.here[0] and any("as configured" in each for each in section.here)
    unknown = identified_section(seasons, ensemble, {})
    assert all(row[6] is None for row in unknown.sheets[0].rows) and "truth" not in unknown.figures[0].caption
    alone = Ensemble({name: member for name, member in ensemble.members.items() if name != "joint_averaged"})
    assert identified_section(seasons, alone, known) is None
