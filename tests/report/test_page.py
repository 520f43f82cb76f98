"""The page of a report: its numbers, its names, its script, what it may load, and what boats may lack."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.support.pages import BAD, Page
from tests.support.runs import tools
from tests.support.seasons import boats, decoded
from usvlearn.estimators.joint.periodic_estimates import shown
from usvlearn.report import front
from usvlearn.report.build import assemble, evaluate, front_of, read
from usvlearn.report.front import MAIN, Ahead, Overview
from usvlearn.report.page import SCRIPT, write_report

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def page_of(folder: Path) -> Page:
    return Page((folder / "index.html").read_text())


def test_the_page_is_one_file_without_links(saved):
    text = (saved / "report" / "index.html").read_text()
    assert set(re.findall(r'(?:src|href)="(?!#|data:)([^"]*)"', text)) == set()
    assert not re.search(r"url\((?!#)", text) and "@import" not in text
    tags = Page(text).tags
    ids = [attrs["id"] for _, attrs in tags if "id" in attrs]
    links = {
        value[1:] for _, attrs in tags for name, value in attrs.items() if name.endswith("href") and value[0] == "#"
    }
    assert len(ids) == len(set(ids)) and links <= set(ids)
    assert "currentColor" in text and "prefers-color-scheme: dark" in text
    assert text.count("<svg") == 20


def test_only_the_viewer_may_run_and_nothing_may_be_loaded(saved):
    page = page_of(saved / "report")
    kinds = [attrs.get("type") for tag, attrs in page.tags if tag == "script"]
    assert kinds == ["application/json", None] and page.scripts[1] == SCRIPT
    (policy,) = (attrs["content"] for tag, attrs in page.tags if attrs.get("http-equiv"))
    digest = base64.b64encode(hashlib.sha256(page.scripts[1].encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; script-src 'sha256-{digest}'; ") and "http" not in policy
    assert not any(name.startswith("on") for _, attrs in page.tags for name in attrs)
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|innerHTML|eval\(|https?:", SCRIPT)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node is installed")
def test_the_script_is_legal(tmp_path):
    (tmp_path / "viewer.js").write_text(SCRIPT)
    subprocess.run(["node", "--check", tmp_path / "viewer.js"], check=True)


def test_numbers_on_the_first_page_are_those_of_the_results(saved):
    results, rows = json.loads((saved / "results.json").read_text()), page_of(saved / "report").rows
    for boat in ("heron1", "heron2"):
        out = results["boats"][boat][results["output"]]
        ahead = results["forecast"][boat][results["output"]]
        said = [["the next step", out["mae"], out["skill"], out["coverage"]]]
        said += [[f"{h} s", row["mae"], row["skill"], row["covers"]] for h, row in ahead.items()]
        for what, mae, skill, covers in said:
            numbers = [("–" if x is None else f"{x:.{n}f}") for x, n in ((mae, 3), (skill, 2))]
            assert [what, *numbers, "–" if covers is None else f"{100 * covers:.0f} %"] in rows
        for name, words in MAIN.items():
            if found := results["identified"][boat].get(name):
                numbers = f"{shown(found['value'])} {found['unit']}", f"{shown(found['low'])} to {shown(found['high'])}"
                assert [words, *numbers] in rows
        row = next(row for row in rows if row[0] == boat and len(row) == 10)  # of the fleet, before the fit's
        assert (row[1], row[3], row[8]) == ("2", f"{out['mae']:.3f}", str(len(results["events"][boat])))
        found = sum(finding["boat"] == boat for finding in results["data_check"])
        assert row[9] == f"{found or 'no'} finding{'s' * (found != 1)}"
        fits = f"{out['fit']:.1f} % one step ahead, {results['free_fit'][boat][results['output']]:.1f} % for whole runs"
        assert f"Fit, 100 (1 − NRMSE): {fits}." in (saved / "report" / "index.html").read_text()
    assert sum(row[0].startswith("00") for row in rows) == 4  # the runs


def test_the_viewers_numbers_are_the_predictions(saved):
    data = page_of(saved / "report").data()
    ensemble, seasons = read([saved], tools())
    runs = [(season.boat, run) for season in seasons for run in season.runs]
    assert [(each["boat"], each["name"]) for each in data["runs"]] == [(boat, run.name) for boat, run in runs]
    weighed = ["joint", "joint_quick", "arx", "joint_averaged"]  # the paper's members wait to be chosen
    assert data["hidden"] == ["aid", "sift_map", "rnn"] and data["shown"] == [*data["hidden"], *weighed, "ensemble"]
    assert len(set(data["colours"].values())) == 8
    boxes = [attrs for tag, attrs in page_of(saved / "report").tags if attrs.get("type") == "checkbox"]
    assert [each["value"] for each in boxes if "checked" in each] == [*weighed, "ensemble"]
    for each, (_, run) in zip(data["runs"], runs, strict=True):
        expected = {
            f"next {name}": run.published["predictions"][:, ensemble.names.index(name)] for name in data["shown"]
        }
        widths = run.published["halfwidths"][:, ensemble.names.index("ensemble")]
        expected["halfwidth"] = np.where(np.isinf(widths), np.nan, widths)  # none is drawn before ten errors
        expected["left"] = np.where(run.samples.fresh, run.samples.inputs.command_left, np.nan)
        for name, x in expected.items():
            half = each["series"][name][2] / 2 + 1e-9
            np.testing.assert_allclose(decoded(each["series"][name]), x, rtol=0, atol=half, err_msg=name)
            assert half < 1e-4 * max(1.0, np.nanmax(np.abs(x)))
        time = np.frombuffer(base64.b64decode(each["time"]), "<f4")
        np.testing.assert_allclose(time, run.time, rtol=1e-6)


def written(folder: Path, change=lambda seasons: seasons, checks=()) -> tuple[str, Page]:
    """The page of two simulated boats without predictions, forecasts and an averaged joint EKF, after some change."""
    ensemble, seasons = boats(np.ones((2, 9)))
    seasons = change(seasons)
    sections, _ = assemble(ensemble, seasons)
    text = write_report(folder, ["One."], sections, front=front_of(ensemble, seasons, checks)).read_text()
    return text, Page(text)


@pytest.mark.usefixtures("drawn_once")
def test_a_boat_without_predictions_forecasts_and_a_reader_has_a_page(tmp_path):
    text, page = written(tmp_path)
    assert text.count("no estimator that reads physical quantities") == 2
    assert text.count("Nobody watched the thrusters") == 2 and text.count("Not made in these runs.") == 2
    assert all("error" not in run["series"] and "free error" in run["series"] for run in page.data()["runs"])
    assert [run["learned"] for run in page.data()["runs"]] == [True, False, True, False]
    free = [row[-1] for row in page.rows if row[0] in ("0", "1") and len(row) == 6]
    assert [x.endswith("*") for x in free] == [True, False] * 2 and all(float(x.rstrip("*")) < 0.02 for x in free)


def test_a_whole_run_that_nothing_was_saved_before_is_said_in_words():
    boat = Overview("heron", 0.1, [], None, [Ahead("the next step", 0.02, 0.3, 0.9)], None, 93.25, None, None, None)
    (row,) = (row for row in Page(front._accuracy(boat)).rows if row[0] == "a whole run")
    assert row == ["a whole run", "not known: no parameters were saved before the run; learn from two logs"]
    known = Page(front._accuracy(boat._replace(free=0.125, free_fit=61.5)))
    assert ["a whole run", "0.125", "", ""] in known.rows
    assert "93.2 % one step ahead, 61.5 % for whole runs." in front._accuracy(boat._replace(free=0.125, free_fit=61.5))


@pytest.mark.usefixtures("drawn_once")
def test_boats_may_have_different_numbers_of_runs(tmp_path):
    def change(seasons):
        return [seasons[0]._replace(runs=seasons[0].runs[:1]), seasons[1]]

    _, page = written(tmp_path, change)
    assert [(run["boat"], run["name"]) for run in page.data()["runs"]] == [
        ("boat0", "0"),
        ("boat1", "0"),
        ("boat1", "1"),
    ]
    places = [attrs["data-run"] for tag, attrs in page.tags if "data-run" in attrs]
    assert places == ["0", "1", "2"]


def test_a_run_of_three_steps_has_a_page(tmp_path):
    def change(seasons):
        def short(run):
            inputs = run.samples.inputs._make(x[:3] for x in run.samples.inputs)
            samples = run.samples._replace(inputs=inputs, **{
                name: getattr(run.samples, name)[:3] for name in ("surge", "fresh", "measured")
            })  # fmt: skip
            return run._replace(samples=samples, time=run.time[:3])

        return [season._replace(runs=(short(season.runs[0]), season.runs[1])) for season in seasons]

    _, page = written(tmp_path, change)
    run = page.data()["runs"][0]
    assert len(decoded(run["series"]["measured"])) == 3 and run["bins"]["free error against speed"] == []


@pytest.mark.filterwarnings("ignore:constrained_layout")  # so long a name leaves a figure no room
def test_names_do_nothing(tmp_path):
    def change(seasons):
        named = [each._replace(name=BAD) for each in seasons[1].runs]
        return [seasons[0], seasons[1]._replace(boat=BAD.replace("/", "_"), runs=tuple(named))]

    finding = {"boat": None, "about": BAD, "kind": BAD, "found": BAD, "expected": BAD, "key": BAD, "severity": BAD}
    _, page = written(tmp_path, change, [[finding]])
    assert not any(tag == "img" for tag, _ in page.tags)
    assert not any(name.startswith("on") for _, attrs in page.tags for name in attrs) and len(page.scripts) == 2
    assert [run["name"] for run in page.data()["runs"]] == ["0", "1", BAD, BAD]
    assert "<" not in page.scripts[0]
    if CHROMIUM is not None:
        assert "<title>2 boats: what was learned</title>" in opened(tmp_path / "index.html", tmp_path / "browser")


@pytest.mark.usefixtures("drawn_once")
def test_findings_of_the_data_check_are_on_the_first_page(tmp_path):
    finding = {"boat": "boat1", "about": "surge", "found": "a top speed of 31", "expected": "at most 15 m/s",
               "key": "data.channels.surge.unit", "severity": "warning"}  # fmt: skip
    note = finding | {"severity": "note", "about": "heading", "key": ""}
    text, page = written(tmp_path, checks=[[note, finding], None])
    fix = "Set <code>data.channels.surge.unit</code>."
    said = f'<li class="bad"><b>surge</b>: found a top speed of 31, expected at most 15 m/s. {fix}</li>'
    assert text.count(said + "<li><b>heading</b>: found") == 1  # warnings first
    assert text.count("Nothing suspicious was found in the log.") == 1
    assert [row[-1] for row in page.rows if row[0] in ("boat0", "boat1") and len(row) == 10] == [
        "no findings", "2 findings",
    ]  # fmt: skip


@pytest.mark.usefixtures("drawn_once")
def test_a_run_that_is_not_finished_has_a_page_and_a_study_states_the_papers_results(saved, tmp_path):
    shutil.copytree(saved, tmp_path / "run")
    (tmp_path / "run" / "results.json").unlink()
    page = evaluate([tmp_path / "run"], tmp_path / "report", tools(), paper=True)
    text = page.read_text()
    assert "is not finished: the report covers the finished part." in text
    assert (
        text.count("<h3>The paper found</h3>") == 5
        and "The paper found" not in (saved / "report/index.html").read_text()
    )
    assert Page(text).data()["runs"] == page_of(saved / "report").data()["runs"]


def opened(path: Path, profile: Path) -> str:
    """The elements of a page after its script has run; what it complains about is an error."""
    done = subprocess.run(
        [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--log-level=0",
         f"--user-data-dir={profile}", "--virtual-time-budget=3000", "--window-size=390,844", "--dump-dom",
         path.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert "CONSOLE" not in done.stderr, done.stderr
    return done.stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")
def test_the_viewer_draws_the_last_run_in_a_browser(saved, tmp_path):
    dom = opened(saved / "report" / "index.html", tmp_path)
    assert dom.count("<canvas") == 6 and '<div id="viewer">' in dom  # no longer hidden
    last = json.loads((saved / "runs.json").read_text())["boats"]["heron2"][-1][0]
    assert f"<h3>heron2, {last}</h3>" in dom and re.search(r'class="readout">0:00 to \d+:\d\d of the run', dom)
