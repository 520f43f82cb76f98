"""The pages of results: titles, tables, links, what cites them, and which script makes which."""

import itertools
import re

import pages
import pytest

ROOT = pages.FOLDER.parents[1]
PAGES = {path.stem: path.read_text() for path in sorted(pages.FOLDER.glob("*.md"))}
MADE = {"index.md", "history.csv", "history.svg"}  # by a run of overview.py


def test_titles_differ():
    titles = [re.match(r"# (.+)\n", text)[1] for text in PAGES.values()]
    assert len(set(titles)) == len(titles) > 20


@pytest.mark.parametrize("name", PAGES)
def test_tables_lists_and_figures_are_rendered(name):
    """Markdown begins a table or a list after an empty line alone; and every figure is there."""
    lines = ["", *PAGES[name].splitlines()]
    for before, line in itertools.pairwise(lines):
        for mark in ("| ", "- "):
            assert not line.startswith(mark) or before == "" or before.startswith(mark[0]), line
    for target in re.findall(r"\]\(([^)#]+)", PAGES[name]):
        assert (pages.FOLDER / target).exists() or target in MADE, target


def test_every_mention_of_a_page_is_of_one_that_exists():
    files = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
    for folder in ("usvlearn", "certify", "configs", "benchmarks", "docs"):
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".md")]
    cited = 0
    for path in files:
        text = path.read_text()
        for found in re.findall(r"docs/benchmarks/(\w+\.\w+)", text):
            assert (pages.FOLDER / found).exists() or found in MADE, f"{path}: {found}"
            cited += 1
        assert not re.search(r"(?<!docs/)(?<!\]\()(?<!\.\./)benchmarks/\w+\.(md|svg)", text), f"{path}: the old folder"
    assert cited > 20


def test_every_page_is_listed_with_what_makes_it():
    rows = {re.search(r"\((\w+)\.md\)", row)[1]: row for row in pages.listing()[2:]}
    assert set(rows) == set(PAGES) - {"index"}
    assert "| `python benchmarks/accuracy.py LOGS` | How well" in rows["accuracy"]
    for name, row in rows.items():
        _, title, command, content, _ = re.split(r" ?\| ?", row)
        script = command.strip("`").split()[1]
        assert (ROOT / script).exists() and content.endswith("."), row
        assert title.startswith(f"[{PAGES[name].splitlines()[0][2:]}]")


def test_a_script_publishes_to_the_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pages, "FOLDER", tmp_path)
    pages.publish("/somewhere/stress.py", ["# Stress", "", "text", ""])
    pages.publish("/somewhere/live_moos.py", "# MOOS", "live_moosdb")
    assert (tmp_path / "stress.md").read_text() == "# Stress\n\ntext\n"
    assert (tmp_path / "live_moosdb.md").read_text() == "# MOOS\n"
    assert capsys.readouterr().out == "# Stress\n\ntext\n# MOOS\n"
