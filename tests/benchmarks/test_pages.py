"""The pages of results: titles, tables, links, what cites them, and the list of all in docs/benchmarks.md."""

import ast
import itertools
import re

import pages
import pytest

ROOT = pages.FOLDER.parents[1]
PAGES = {path.stem: path.read_text() for path in sorted(pages.FOLDER.glob("*.md"))}
ROW = re.compile(r"^\| (?P<result>.+) \| \[[^]]+\]\(benchmarks/(?P<page>\w+)\.md\) \| `(?P<command>[^`]+)` \|$", re.M)
OTHERS = {"study": "python evaluate.py experiment=paper"}  # pages without a script of their name


def command(name: str) -> str:
    """How the script of a page is called, by its docstring."""
    called = f"python benchmarks/{name}.py"
    docstring = ast.get_docstring(ast.parse((ROOT / "benchmarks" / f"{name}.py").read_text())) or ""
    usage = re.search(rf"^{re.escape(called)}[^\n]*?(?=  |$)", docstring, re.MULTILINE)
    return usage[0] if usage else called


def test_titles_differ():
    titles = [re.match(r"# (.+)\n", text)[1] for text in PAGES.values()]
    assert len(set(titles)) == len(titles) > 10


@pytest.mark.parametrize("name", PAGES)
def test_tables_lists_and_figures_are_rendered(name):
    """Markdown begins a table or a list after an empty line alone; and every figure is there."""
    lines = ["", *PAGES[name].splitlines()]
    for before, line in itertools.pairwise(lines):
        for mark in ("| ", "- "):
            assert not line.startswith(mark) or before == "" or before.startswith(mark[0]), line
    for target in re.findall(r"\]\(([^)#]+)", PAGES[name]):
        assert (pages.FOLDER / target).exists(), target


def test_every_mention_of_a_page_is_of_one_that_exists():
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for folder in ("usvlearn", "certify", "configs", "benchmarks", "docs"):
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".md")]
    cited = 0
    for path in files:
        text = path.read_text()
        for name in re.findall(r"docs/benchmarks/(\w+\.\w+)", text):
            assert (pages.FOLDER / name).exists(), f"{path}: {name}"
            cited += 1
        assert not re.search(r"(?<!docs/)(?<!\]\()(?<!\.\./)benchmarks/\w+\.(md|svg)", text), f"{path}: the old folder"
    assert cited > 5


def test_every_page_is_listed_once_with_what_makes_it():
    text = (pages.FOLDER.parent / "benchmarks.md").read_text()
    rows = list(ROW.finditer(text))
    assert sorted(row["page"] for row in rows) == sorted(PAGES)
    assert len(re.findall(r"\(benchmarks/", text)) == len(rows)  # no link beside them, so there is one list
    for row in rows:
        assert row["command"] == (OTHERS.get(row["page"]) or command(row["page"])), row["page"]
        assert re.search(r"\d", row["result"]), f"{row['page']}: a result without a figure"


def test_a_script_publishes_to_the_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pages, "FOLDER", tmp_path)
    pages.publish("/somewhere/stress.py", ["# Stress", "", "text", ""])
    assert (tmp_path / "stress.md").read_text() == "# Stress\n\ntext\n"
    assert capsys.readouterr().out == "# Stress\n\ntext\n"
