"""The comparison: what its families are, what it counts, and that its words, tables, pictures and page say it."""

import contextlib
import io
import itertools
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import usvlearn.report
from certify.__main__ import main
from certify.analysis import comparison_counts
from certify.analysis.assess import solver
from certify.analysis.comparison_counts import TIERS, contingency, summarise
from certify.analysis.families import initial_networks, random_networks, trained_networks
from certify.analysis.paper_tests import paper_tests, truncated_equilibria
from certify.command.compare import examine
from certify.display.comparison_figures import pictures
from certify.display.comparison_page import STYLE, check_folder
from certify.display.comparison_tables import headline, limit, parts
from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.equilibria import equilibria

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long

QUICK = ["compare", "--quick", "--networks", "6", "--training", "50", "--seconds", "0.05"]


def test_families_are_what_they_are_called():
    rng = np.random.default_rng(0)
    K = [float(exact.conditions(w.a, w.w1)["tight"].rate) for w in random_networks(40, 8, rng)]
    assert 0.03 <= min(K) < 0.1 and 1 < max(K) <= 3
    assert all(np.abs(w.a).max() <= 8**-0.5 and np.abs(w.W2).max() <= 5**-0.5 for w in initial_networks(5, 8, rng))
    slopes = []
    for weights in trained_networks(3, 20, rng, dt=0.4, steps=800):  # it learned a hull: a slope just below 1
        x, u = np.array([0.1, 0.3]), np.array([0.5, 1.0, 0.6, 0.6])
        y = np.maximum(weights.w1 * x[:, None] + weights.W2 @ u + weights.b, 0) @ weights.a
        slopes.append((y[1] - y[0]) / 0.2)
        v = 2 * 2.0 * 0.3
        expected = v + 0.4 * (-0.125 * v * v - 0.05 * v + 2 * (0.25 * (0.6 + 0.36) - 0.1 * 0.6 * v))
        assert y[1] == pytest.approx(expected / 4, abs=0.03)
    assert 0.7 < np.mean(slopes) < 1.0


def test_summary_counts_what_was_examined():
    rng = np.random.default_rng(1)
    networks = random_networks(12, 4, rng)
    rows = [examine(w, solver(), 2.0, 0.5) for w in networks]
    told = summarise(rows)
    for chain in (("simple", "gershgorin", "lmi", "tight", "interval", "box"), (TIERS[1], TIERS[3], "lmi")):
        shares = [told[tier]["share"] for tier in chain]
        assert shares == sorted(shares)
    assert told["tight"]["share"] == np.mean([row["K"] < 1 for row in rows])
    assert told["lmi"]["conservatism"] == pytest.approx(2) and told["tight"]["conservatism"] == pytest.approx(1)
    assert told["box"]["conservatism"] <= 1 + 1e-9
    assert told["lmi"]["disagreements"] == told["tight"]["disagreements"] == 0
    K = [row["K"] for row in rows if row["K"] < 1]
    assert told["tight"]["largest_K"] == max(K) and told["lmi"]["largest_K"] == max(x for x in K if x < 0.5)
    assert told["tight"]["largest_time_constant"] == pytest.approx(-0.5 / np.log(max(K)))
    low, high = told["tight"]["share_interval"]
    assert low < told["tight"]["share"] < high and summarise(rows, drawn=False)["tight"]["share_interval"] is None
    for name in ("simple", "gershgorin", "lmi", "tight"):
        assert told[name]["largest_K"] is None or told[name]["largest_K"] < limit(name, 4)
    assert all(row["K_box"][0] <= row["K"] + 1e-12 for row in rows)
    for row in rows:
        assert row["closed"] and row["K_box"][1] - row["K_box"][0] <= 1e-5 * row["K_box"][1]
        s = networks[rows.index(row)].a * networks[rows.index(row)].w1
        assert row["loss"]["ratio"] == pytest.approx(np.abs(s).sum() / row["K"]) and row["loss"]["false"] == []
    assert not examine(random_networks(1, 40, rng)[0], None, 1e-6)["closed"]  # too little time
    rows[0]["solved"]["tight"]["verdict"] = "unknown" if rows[0]["certified"]["tight"] else "certified"
    assert summarise(rows)["tight"]["disagreements"] == 1


def test_the_contingency_table():
    rows = [examine(w, None, 1.0) for w in random_networks(60, 5, np.random.default_rng(4))]
    for gauge, found in contingency(rows).items():
        assert sum(found[key] for key in ("both", "only_lmi", "only_gershgorin", "neither")) == 60
        assert found["only_gershgorin"] == 0 < found["both"]  # a theorem
        assert found["both"] + found["only_lmi"] == sum(row["certified"]["lmi"] for row in rows)
        assert found["missed_interval"][0] <= found["missed"] <= found["missed_interval"][1], gauge
    assert contingency(rows)["best gauge"]["both"] > contingency(rows)["as given"]["both"]
    rows[0]["certified"] |= {"lmi": False, "gershgorin": True}
    assert contingency(rows)["as given"]["only_gershgorin"] == 1


def test_the_papers_tests_literally_and_mended():
    class Choices:
        corner, order, knots, solver = "both", "both", "both", "CLARABEL"

    networks = [w for w in random_networks(60, 6, np.random.default_rng(2)) if np.abs(w.a * w.w1).sum() > 0]
    rows = {row["test"]: row for row in paper_tests(networks, Choices)}
    assert rows["M ⪰ 0, 2Λ"]["identity"] and not rows["M ≻ 0, 2Λ"]["identity"]
    assert not rows["M ⪰ 0, Λ"]["identity"] and not rows["M ≻ 0, Λ"]["identity"]
    assert rows["M ≻ 0, Λ"]["beyond"][0] == rows["M ≻ 0, 2Λ"]["beyond"][0] == 0
    assert rows["M ⪰ 0, 2Λ"]["beyond"][0] > 0  # the solver's word, where no such network contracts
    assert rows["M ⪰ 0, 2Λ"]["contracting"] == 0 < rows["M ⪰ 0, Λ"]["contracting"]
    assert all(rows[key]["inside"][0] == rows[key]["inside"][1] for key in rows if key.startswith("M"))
    assert (
        rows["equilibria at u = 0, all knots"]["wrong"][0] == 0 < rows["equilibria at u = 0, knots i < n"]["wrong"][0]
    )
    Choices.corner, Choices.order, Choices.knots = "lambda", "strict", "all"
    assert [row["test"] for row in paper_tests(networks[:3], Choices)] == ["M ≻ 0, Λ", "equilibria at u = 0, all knots"]


def test_truncated_equilibria_are_right_where_the_last_neuron_has_no_knot():
    weights = ShallowWeights([1.5, 0.1], [1.0, 0.0], np.zeros((2, 1)), [-0.25, 1.0])
    weights = ShallowWeights(*map(np.asarray, weights))
    found = [each.x for each in equilibria(weights, [0.0])]
    assert truncated_equilibria(weights) == pytest.approx(found)
    turned = ShallowWeights(*(x[::-1] for x in weights))  # the same map, its only knot last
    assert len(truncated_equilibria(turned)) != len(found)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The command's output as text, its result, and the folder of its page."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("cvxpy")
    folder = tmp_path_factory.mktemp("compare")
    np.savez(folder / "own <b>&|.npz", a=[0.9], w1=[1.0], W2=np.zeros((1, 4)), b=[0.5])
    said = []

    def say(write, *arguments):
        with contextlib.redirect_stdout(io.StringIO()) as text:
            write(*arguments)
        said.append(text.getvalue())

    from certify.command.compare import main as compare

    places = ["--page", str(folder / "page"), "--plot", str(folder / "c.pdf")]
    assert compare([str(folder / "own <b>&|.npz"), *QUICK[1:], "--corner", "2lambda", *places], say) == 0
    return said[0], json.loads((folder / "page" / "comparison.json").read_text()), folder


def test_the_terminal_says_the_result_first(made):
    text, result, _ = made
    words = " ".join(text.split())  # without the ends of lines
    assert words.startswith(headline(result))
    assert "never loses more than a factor of 2" in headline(result) and "σ/K" in headline(result)
    assert max(map(len, (line for line in text.splitlines() if "  " in line.strip()))) <= 170
    for part in parts(result):
        assert part.title in text and all(sentence in words for sentence in part.said)
        assert all(table.title in text for table in part.tables)
        assert all(len(row) == len(table.headings) for table in part.tables for row in table.rows)
    for known in ("random: 6 networks", "LMI again", "M ⪰ 0, 2Λ", "box", "only Gershgorin"):
        assert known in text


def test_the_result_holds_all(made):
    _, result, _ = made
    assert set(result["families"]) == {"random", "initialised", "trained", "run own <b>&|"}
    theorem = result["theorem"]
    assert result["families"]["random"]["ratio"]["interval"] and not result["families"]["run own <b>&|"]["drawn"]
    drawn = sum(len(family["networks"]) for family in result["families"].values())
    swept = sum(row["networks"] for name in ("by_neurons", "by_signs") for row in result[name])
    assert theorem["networks"] + theorem["without_slope"] == drawn + swept and theorem["false"] == []
    assert 1 <= theorem["least"] <= theorem["greatest"] <= 2
    assert {row["n"] for row in result["by_neurons"]} == {4, 8} == {row["n"] for row in result["timings"]}
    assert all(row["tiers"]["lmi"]["median"] == 2 for row in result["by_neurons"])
    for row in result["by_signs"]:
        assert 1 <= row["ratio"]["least"] <= row["ratio"]["median"] <= row["ratio"]["greatest"] <= 2
        assert (row["rarer"] == 0) == (row["ratio"]["greatest"] == 1)
    assert all(0 < row["solver"] < row["lmi_again"] < row["lmi_first"] for row in result["timings"])
    assert [row["m"] for row in result["box_times"]] == [1, 2, 3, 4, 5, 6, 8]


def test_a_theorem_that_fails_is_said_first(made):
    _, result, _ = made
    broken = {**result, "theorem": {**result["theorem"], "false": ["the ratio is σ/K"]}}
    assert "NOT confirmed: the ratio is σ/K" in headline(broken)
    assert "fails" in " ".join(parts(broken)[0].said) and "holds on all" not in " ".join(parts(broken)[0].said)
    family = {**result["families"]["random"], "contingency": {"as given": {
        **result["families"]["random"]["contingency"]["as given"], "only_gershgorin": 2}}}  # fmt: skip
    assert "CONTRADICTS" in " ".join(parts({**result, "families": {"random": family}})[3].said)


def test_networks_without_a_slope_and_without_a_step_are_shown(made):
    _, result, _ = made
    usual = set(pictures(result))
    zero, one = np.zeros(2), np.ones(2)
    for dt in (None, 0.4):
        rows = [examine(ShallowWeights(zero, one, np.zeros((2, 1)), one), None, 0.5, dt)]
        family = {"drawn": False, "networks": rows, "tiers": summarise(rows, False),
                  "contingency": contingency(rows, False), **comparison_counts.of_losses(rows, False)}  # fmt: skip
        alone = {**result, "families": {"run zero": family}}
        text = " ".join(cell for part in parts(alone) for table in part.tables for row in table.rows for cell in row)
        assert rows[0]["loss"] is None and "nan" not in text
        assert usual - set(pictures(alone)) == ({"constants"} if dt is None else set())
    rows[0]["closed"] = False
    assert "Of 1 networks the rate on the box was not found" in " ".join(parts(alone)[2].said)
    assert headline({**result, "theorem": {"networks": 0, "false": []}}).startswith("No network of this run has")


class Elements(HTMLParser):
    """The tags of a page, what it loads, and its text."""

    def __init__(self):
        super().__init__()
        self.tags, self.loaded, self.text, self.ids = [], [], [], []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append(tag)
        self.ids += [found["id"]] if "id" in found else []
        self.loaded += [found[key] for key in ("src", "href", "xlink:href") if key in found]

    def handle_data(self, data):
        self.text.append(data)


def test_the_page(made):
    _, result, folder = made
    page = Elements()
    whole = (folder / "page" / "index.html").read_text()
    page.feed(whole)
    text = "".join(page.text)
    assert all(link.startswith(("#", "data:")) for link in page.loaded) and "script" not in page.tags
    assert not re.search(r"url\((?!#)", whole) and "@import" not in whole
    assert len(set(page.ids)) == len(page.ids)
    assert page.tags.count("svg") == len(pictures(result)) == 6 and "b" not in page.tags
    assert text.index(headline(result)) < text.index("What does Gershgorin lose")
    assert "own <b>&|: " in text and "∎" in text and "95 %" in text
    for part in parts(result):
        assert all(cell in text for table in part.tables for row in table.rows for cell in row)
    markdown = (folder / "page" / "report.md").read_text()
    assert not re.search(r"<\w", markdown.partition("```")[0])
    assert headline(result) in markdown and "∎" in markdown
    assert not re.search(r"_\{|\b[acsz]_i", text + markdown) and "|w₁ᵢ| = ½" in text and "|w₁ᵢ| = ½" in markdown
    for target in re.findall(r"\]\(([^)]+\.svg)\)", markdown):
        assert (folder / "page" / target).stat().st_size > 3000
    lines = ["", *markdown.splitlines()]
    assert all(not before or before[0] == "|" for before, line in itertools.pairwise(lines) if line[:2] == "| ")
    widths = [len(re.findall(r"(?<!\\)\|", line)) for line in lines if line[:2] == "| "]
    assert min(widths) > 3
    assert sorted(path.name for path in folder.glob("c-*.pdf")) == [
        f"c-{name}.pdf" for name in sorted(pictures(result))
    ]


@pytest.mark.parametrize("sizes", [[4, 8], [95, 100, 105, 500], [7]])
def test_no_picture_has_an_empty_panel_or_texts_that_touch(made, sizes):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    result = dict(made[1])
    for key in ("by_neurons", "timings"):  # other sizes in place of the measured ones
        families = dict.fromkeys(row.get("family") for row in result[key])
        first = {family: next(row for row in result[key] if row.get("family") == family) for family in families}
        result[key] = [{**row, "n": n} for row in first.values() for n in sizes]
    for name, (figure, caption) in pictures(result).items():
        assert caption.endswith(".")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        across = [text.get_window_extent(renderer) for axes in figure.axes for text in axes.get_xticklabels()]
        assert not any(one.overlaps(two) for one, two in itertools.combinations(across, 2)), name
        for axes in figure.axes:
            assert sum(len(line.get_xdata()) for line in axes.lines) > 1, name
            groups = [axis.get_ticklabels() for axis in (axes.xaxis, axes.yaxis)]
            groups.append([text for text in axes.texts if text.get_transform() == axes.transAxes])
            for texts in groups:
                boxes = [text.get_window_extent(renderer) for text in texts if text.get_text()]
                assert not any(one.overlaps(two) for one, two in itertools.combinations(boxes, 2)), name
            if legend := axes.get_legend():  # beside the axes, not across their lines
                assert legend.get_window_extent(renderer).x0 >= axes.get_window_extent(renderer).x1, name


def test_the_page_looks_like_the_report_of_a_run():
    report = (Path(usvlearn.report.__file__).parent / "page.css").read_text()
    variables = [set(re.findall(r"--\w+: ?#\w+", style)) for style in (STYLE, report)]
    assert variables[0] == variables[1] and len(variables[0]) > 10
    for rule in (r"body \{.*?\}", r"\.wide svg \{.*?\}", r"h1 \{.*?\}"):
        one, other = (re.sub(r"\s+", " ", re.search(rule, style, re.DOTALL)[0]) for style in (STYLE, report))
        assert one == other


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--networks", "0"], "--networks: found 0"),
        (["--sizes", "4,x"], "--sizes: found '4,x'"),
        (["--dt", "nan"], "--dt: found nan"),
        (["--checkpoints", "0"], "--checkpoints: found 0"),
        (["--sets", "9"], "--sets: it is --checkpoints now"),
        (["--unknown"], "unrecognized arguments"),
        (["nowhere"], "nowhere: no such file"),
        (["--page", "{file}"], "--page: found"),
        (["--page", "{other}"], "holds something that is no page"),
        (["--page", "{file}/below"], "cannot be made"),
        (["--plot", ""], "--plot: found ''"),
        (["--plot", "picture.xyz"], "expected a file such as compare.png"),
    ],
)
def test_bad_input_is_told_before_the_work(tmp_path, capsys, arguments, words):
    (tmp_path / "file").write_text("x")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("x")
    places = {"file": tmp_path / "file", "other": tmp_path / "other"}
    assert main([*QUICK, *(each.format(**places) for each in arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and words in error and error.count("\n") == 1
    assert (tmp_path / "other" / "thesis.tex").read_text() == "x"


def test_a_page_without_matplotlib_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main([*QUICK, "--page", str(tmp_path / "page")]) == 2
    error = capsys.readouterr().err
    assert "needs matplotlib: run `pip install 'usvlearn[plot]'`" in error and not (tmp_path / "page").exists()


def test_without_a_solver(tmp_path, capsys, monkeypatch):
    """Only families, counts and text: the costly parts are left out."""
    assert main([*QUICK, "--no-lmi", "--json", "--neurons", "3", "--sizes", "2"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["families"]) == {"random", "initialised", "trained"} and result["paper"] == []
    assert result["timings"][0]["lmi_again"] is None and result["solver"] is None
    assert result["families"]["random"]["tiers"]["lmi"]["disagreements"] is None
    assert [part.key for part in parts(result)] == ["gauge", "neurons", "shares", "contingency", "constants", "times"]
    assert len(pictures(result)) == 6
    assert comparison_counts.middle([1.0, np.inf, np.inf])["median"] is None


@pytest.mark.parametrize("name", ["figures", "index.html", "figures/mine.svg"])
def test_a_page_is_written_through_no_link(tmp_path, name):
    (tmp_path / "there").mkdir()
    link = tmp_path / "page" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "there")
    (tmp_path / "page" / "comparison.json").touch()
    with pytest.raises(CertifyError, match=f"{link.name} is a link"):
        check_folder(tmp_path / "page")
    assert list((tmp_path / "there").iterdir()) == []
