"""The section on a batch fit: its numbers, what it says of the log, files that are damaged or forged, and the page."""

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest

from tests.support import few
from tests.support.pages import BAD, Page
from tests.support.runs import tools
from tests.support.saved_fits import facts
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.report.build import read
from usvlearn.report.front import MAIN, Front, Overview, first_page
from usvlearn.report.page import write_report
from usvlearn.report.sections.fit import DOUBTED, UNKNOWN, USES, fit_section
from usvlearn.report.sections.fit_file import FEW, saved_fits
from usvlearn.report.sections.section import Section

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long


@pytest.fixture
def folder(tmp_path) -> Path:
    write(tmp_path, facts())
    return tmp_path


def write(folder: Path, content, boat: str = "heron1") -> Path:
    (folder / "fit").mkdir(exist_ok=True)
    path = folder / "fit" / f"{boat}.fit.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.fixture(scope="session")
def season(saved):
    ensemble, seasons = read([saved], tools())
    return ensemble, seasons


def section_of(season, folder: Path, truth=None) -> Section | None:
    ensemble, seasons = season
    return fit_section(seasons, ensemble, saved_fits([folder], ["heron1", "heron2"]), truth or {})


def page_of(section: Section, folder: Path) -> tuple[str, Page]:
    text = write_report(folder / "report", [], [section]).read_text()
    return text, Page(text)


def table(section: Section, name: str) -> list[dict]:
    (sheet,) = (each for each in section.sheets if each.name == name)
    return [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]


def test_a_run_without_a_fit_has_no_section(season, tmp_path):
    assert section_of(season, tmp_path) is None


def test_the_numbers_are_those_of_the_file_beside_those_learned_online(season, folder):
    quantities = facts()["quantities"]
    section = section_of(season, folder, {"heron1": {"steady_speed_full": quantities["steady_speed_full"]["value"]}})
    rows = table(section, "fit")
    assert [row["quantity"] for row in rows] == [*quantities] and {row["boat"] for row in rows} == {"heron1"}
    for row in rows:
        expected = quantities[row["quantity"]]
        assert [row["fit"], row["from (90 %)"], row["to (90 %)"]] == [expected[x] for x in ("value", "low", "high")]
        assert row["use the fit"] == "yes" and (row["truth"] is not None) == (row["quantity"] == "steady_speed_full")
    assert any(row["online"] is not None for row in rows)
    assert "The intervals of the fit hold 100 % of the truths (90 % asked)." in section.here
    sets = {row["terms"]: row for row in table(section, "fit_sets")}
    assert sets["nine"]["worse by, a step"] == 0.5 and sets["nine"]["± (one deviation)"] is None
    assert [name for name, row in sets.items() if row["used"]] == ["cubic"]
    missions = facts()["diagnostics"]["missions"]
    assert [row["MAE, m/s"] for row in table(section, "fit_missions")] == [each["mae"] for each in missions]
    assert [drawn.name for drawn in section.figures] == [f"fit_{x}_heron1" for x in ("curves", "residuals", "worst")]


def test_what_the_log_does_not_determine_is_marked(season, folder):
    saved = deepcopy(facts())
    saved["quantities"]["drag_linear"] = {"value": -3.0, "low": -6.0, "high": 1.0, "unit": "kg/s"}
    saved["quantities"]["thrust_ratio"] = {"value": None, "low": None, "high": None, "unit": ""}
    saved["quantities"]["compass_offset"] = {"value": 0.1, "low": -0.1, "high": 0.3, "unit": "deg"}  # known, and near 0
    write(folder, saved)
    uses = {row["quantity"]: row["use the fit"] for row in table(section_of(season, folder), "fit")}
    assert {name for name, use in uses.items() if use == UNKNOWN} == {"drag_linear", "thrust_ratio"}


def test_values_with_a_doubt_are_not_recommended(season, folder):
    write(folder, facts())
    assert USES in section_of(season, folder).here
    write(folder, facts() | {"doubts": ["The lag of the thrust is at its bound."]})
    section = section_of(season, folder)
    assert USES not in section.here and {row["use the fit"] for row in table(section, "fit")} == {DOUBTED}
    assert any("before this is settled: The lag of the thrust is at its bound." in each for each in section.here)


def test_sentences_say_what_the_figures_show(season, folder):
    saved = deepcopy(facts())
    diagnosed = saved["diagnostics"]
    for side, edge in (("left", -0.01), ("right", 2.0)):
        each = diagnosed["sailed"][side]
        each["seconds"] = [30.0 if start > edge or edge > 1 else 0.0 for start in each["edges"][:-1]]
    cross = diagnosed["cross_correlation"]
    cross["mean"]["values"] = [0.5 if lag == 4 else 0.0 for lag in cross["mean"]["lags"]]
    cross["difference"]["values"] = [None for _ in cross["difference"]["lags"]]
    diagnosed["missions"][0]["current"] = [0.6, -0.6]
    saved["terms"], saved["sets"] = "cubic, wear", {"cubic, wear": saved["sets"]["cubic"]}
    write(folder, saved)
    here = section_of(season, folder).here
    assert any("its simulation of these missions errs by 0.040 m/s." in each for each in here)
    assert any("the parameters are those of its last mission" in each for each in here)
    assert any("Open-loop simulation: use the fit's: the fit errs by 0.0500 m/s" in each for each in here)
    assert "heron1: The thrusters hardly ever pushed astern." in here
    assert "heron1: it sailed with left commands from −0.05 to 1.00: what is beyond is an extrapolation." in here
    said = "errors follow the mean command: 1 of 121 lags are beyond their bounds, most at 4 s (+0.50)."
    assert f"heron1: {said}" in here
    assert any("the difference of the commands never changed" in each for each in here)
    assert any("in 1 mission the current is above 0.6 m/s" in each for each in here)
    assert any("the report has 2 runs, less than the fit" in each for each in here)


def test_files_of_other_boats_and_folders_are_not_read(season, tmp_path):
    (tmp_path / "run").mkdir()
    write(tmp_path, facts(), "heron3")
    write(tmp_path / "run", facts(), "else")
    assert saved_fits([tmp_path, tmp_path / "run"], ["heron1", "../fit/heron2"]) == {}
    write(tmp_path, facts() | {"boat": "../../x", "terms": "nine"})
    write(tmp_path / "run", facts())
    assert saved_fits([tmp_path, tmp_path / "run"], ["heron1"])["heron1"].terms == "cubic"  # of the last run
    figures = [drawn.name for drawn in section_of(season, tmp_path).figures]
    assert all(name.endswith("_heron1") for name in figures)


def changed(*path, value) -> Callable[[], str]:
    """Makes the file with one value changed."""

    def text() -> str:
        place = saved = deepcopy(facts())
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        return json.dumps(saved)

    return text


MISSIONS, DRAG = ("diagnostics", "missions"), ("diagnostics", "curves", "drag")
SAILED, WHITE = ("diagnostics", "sailed", "left"), ("diagnostics", "autocorrelation")


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "null", "[" * 100_000, "{}", lambda: json.dumps(facts())[:-900],
        lambda: json.dumps(facts()).replace("0.05,", "NaN,", 1), changed("mass", value="28"),
        changed("mass", value=True), changed("missions", value=10**400), changed("missions", value=None),
        changed("sets", value=[]),
        changed("quantities", value={}), changed("quantities", value=[1]), changed("quantities", "mass", value=3),
        changed("quantities", "drag_linear", value=3),
        changed("quantities", "drag_linear", "low", value=1e300), changed("terms", value="x" * 10_000),
        changed("terms", value=["nine"]), changed("lacks", value=["x"] * (FEW + 1)), changed("lacks", value="x"),
        changed("diagnostics", value=None),
        changed("simulation", "sentence", value=3), changed("simulation", "sentence", value=[]),
        changed("simulation", value=1), changed("simulation", "sentence", value=None), changed("diagnostics", value=[]),
        changed(*MISSIONS, value={}), changed(*MISSIONS, 0, "worst", value=5),
        changed(*MISSIONS, value=[{}] * 10_001), changed("diagnostics", "worst", 0, "time", value=[1.0]),
        changed(*DRAG, "value", value=[1.0]), changed(*DRAG, "at", 3, value=9e8), changed(*DRAG, value=None),
        changed(*DRAG, "low", 0, value=None), changed(*SAILED, "seconds", 0, value=-1.0),
        changed(*SAILED, "edges", value=[0.0]), changed(*WHITE, value={}), changed(*WHITE, "bounds", 3, value=-1.0),
        changed(*WHITE, "lags", 3, value=0.5), changed("diagnostics", "cross_correlation", value={"mean": 1}),
    ],
)  # fmt: skip
def test_a_damaged_file_is_a_sentence(season, folder, text):
    text = text() if callable(text) else text
    path = write(folder, text)
    section = section_of(season, folder)
    (sentence,) = section.here
    assert sentence.startswith("fit/heron1.fit.json: is damaged (") and sentence.endswith(
        f"run usvlearn fit {folder} again."
    )
    assert len(sentence) < 250 + len(str(folder)) and not section.figures and not section.sheets
    assert path.read_text() == text


@pytest.mark.parametrize("unknown", few([True, False], [True], "thorough"))
def test_extreme_numbers_are_drawn(season, folder, unknown):
    saved = deepcopy(facts())
    rng = np.random.default_rng(0)

    def spoil(x):
        if isinstance(x, dict):
            return {
                key: x[key] if key in ("at", "edges", "name", "start", "lags", "bounds") else spoil(x[key]) for key in x
            }
        if isinstance(x, list):
            return [spoil(each) for each in x]
        return (None if unknown else float(rng.choice([-9e8, 0.0, 9e8]))) if isinstance(x, float | int) else x

    curves, sailed = (deepcopy(saved["diagnostics"][key]) for key in ("curves", "sailed"))
    saved["diagnostics"] = spoil(saved["diagnostics"]) | {"sailed": sailed}
    if unknown:
        saved["diagnostics"]["curves"] = curves
        for each in saved["diagnostics"]["missions"]:
            each["current"] = None
    write(folder, saved)
    section = section_of(season, folder)
    assert len(section.figures) == 3
    text, _ = page_of(section, folder)
    assert text.count("<svg") == 3


def test_names_of_a_forged_file_do_nothing(season, folder):
    saved, name = deepcopy(facts()), BAD + r"$\frac{$ & \x1b[2J"
    saved |= {"boat": name, "terms": name, "lacks": [name], "sets": {name: saved["sets"]["nine"]}}
    saved["quantities"][name] = saved["quantities"]["drag_linear"]
    for part in ("missions", "worst"):
        for each in saved["diagnostics"][part]:
            each["name"] = name
    write(folder, saved)
    section = section_of(season, folder)
    assert name not in [row["quantity"] for row in table(section, "fit")]
    text, page = page_of(section, folder)
    assert not any(tag in ("img", "script") for tag, _ in page.tags) and "<img" not in text
    assert not any(key.startswith("on") for _, attrs in page.tags for key in attrs)
    assert "&lt;img src=x" in text
    assert {each.name for each in (folder / "report" / "figures").iterdir()} == {
        f"fit_{x}_heron1.svg" for x in ("curves", "residuals", "worst")
    }


def test_the_tables_of_a_fit_stand_open_before_its_figures(season, folder):
    text, _ = page_of(section_of(season, folder), folder)
    places = [text.index(each) for each in ("fit: table", "fit_sets: table", "<svg", "fit_missions: table")]
    assert places == sorted(places) and "<details open><summary>fit: table" in text


def test_the_first_page_has_the_values_of_the_fit_before_those_learned_online():
    batch = {"steady_speed_full": Quantity(2.0, 1.9, 2.1, "m/s"), "drag_half_speed": Quantity(9.0, 1.0, 17.0, "N")}
    boat = Overview("heron", 1.0, [], None, [], None, None, None, None, None)
    front = Front([boat], {"runs": [], "colours": {}, "hidden": [], "shown": [], "sides": {}})
    assert "#fit" not in first_page(front, "")
    text = first_page(front._replace(boats=[boat._replace(batch=batch)]), "")
    assert [MAIN["steady_speed_full"], "2.00 m/s", "1.90 to 2.10"] in Page(text).rows
    assert text.index('href="#fit"') < text.index("1.90 to 2.10") < text.index("Learned online")
    assert "The log does not determine: drag at half of that speed." in text
