"""The builder of the site finds what is wrong in its pages, and every page of docs/ has a place in it."""

import json
import re

import pytest
import yaml
from make_site import faults

import usvlearn
from tests.support import ROOT

GOOD = (
    '<h1 id="top">Start</h1><a href="#top">up</a><a href="b.html#there">on</a><img src="a.png"><a href="https://x.y">'
    '<picture><source srcset="a.png 1x, a.png 2x"></picture>'
)


@pytest.fixture
def site(tmp_path):
    (tmp_path / "a.html").write_text(GOOD)
    (tmp_path / "b.html").write_text('<h2 id="there">There</h2>')
    (tmp_path / "a.png").write_bytes(b"")
    return tmp_path


def test_a_site_without_faults_has_none(site):
    assert faults(site) == []


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("b.html#there", "c.html", "a.html: links to c.html, which is not there"),
        ("b.html#there", "b.html#gone", "a.html: links to b.html#gone, and there is no such place"),
        ("#top", "#bottom", "a.html: links to #bottom, and there is no such place"),
        ('src="a.png"', 'src="b.png"', "a.html: links to b.png, which is not there"),
        ("a.png 2x", "b.png 2x", "a.html: links to b.png, which is not there"),
        ('src="a.png"', 'src="https://x.y/a.png"', "a.html: loads https://x.y/a.png from outside"),
        ("<img", '<script src="//x.y/s.js"></script><img', "a.html: loads //x.y/s.js from outside"),
    ],
)
def test_each_fault_is_named(site, old, new, fault):
    page = site / "a.html"
    page.write_text(page.read_text().replace(old, new))
    assert faults(site) == [fault]


def test_examples_of_docstrings_become_blocks():
    pytest.importorskip("griffe", reason="needs the extra docs")
    from doctests import fenced

    assert fenced("Sums.\n\n>>> 1 + 1\n2\n\nMore.\n\n>>> 2\n2") == (
        "Sums.\n\n```pycon\n>>> 1 + 1\n2\n```\n\nMore.\n\n```pycon\n>>> 2\n2\n```"
    )
    assert fenced("No example.") == "No example."


def test_the_star_of_an_optimum_begins_no_emphasis():
    pytest.importorskip("griffe", reason="needs the extra docs")
    from doctests import starred

    assert starred("x* and *a* word.\n\n    x* = 1") == "x\\* and *a* word.\n\n    x* = 1"


def test_comments_of_fields_become_their_descriptions(tmp_path):
    griffe = pytest.importorskip("griffe", reason="needs the extra docs")
    from doctests import Doctests

    (tmp_path / "shapes.py").write_text(
        'class Box:\n    """A box."""\n\n    width: float  # m\n    depth: float\n    tall: int = 1  # steps\n'
    )
    box = griffe.load("shapes", search_paths=[tmp_path], extensions=griffe.load_extensions(Doctests))["Box"]
    said = {name: member.docstring and member.docstring.value for name, member in box.members.items()}
    assert said == {"width": "m", "depth": None, "tall": "steps"}


def pages_of(tree):
    for entry in tree:
        for value in entry.values() if isinstance(entry, dict) else [entry]:
            yield from pages_of(value) if isinstance(value, list) else [value]


NAMED = sorted(pages_of(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]))


def test_the_menu_names_every_page_once_but_data_pages_and_decisions():
    docs = ROOT / "docs"
    tutorials = {f"tutorials/{path.stem}.md" for path in (docs / "tutorials").glob("*.ipynb")}
    there = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")} | tutorials
    assert sorted(name for name in there if not name.startswith(("adr/", "benchmarks/"))) == NAMED


def test_the_site_stays_short():
    """At most 30 written pages with 46,150 words; code, formulas and the pages made of docstrings do not count."""
    written = [name for name in NAMED if not name.startswith("reference/") or name == "reference/index.md"]
    assert len(written) <= 30
    words = 0
    for name in written:
        path = ROOT / "docs" / name
        if path.with_suffix(".ipynb").exists():
            cells = json.loads(path.with_suffix(".ipynb").read_text())["cells"]
            text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        else:
            text = (ROOT / "CONTRIBUTING.md" if name == "contributing.md" else path).read_text()
        text = re.sub(r"^( *)```.*?^\1```|\$\$.*?\$\$|<!--.*?-->", "", text, flags=re.M | re.S)
        words += sum(bool(re.search(r"\w", word)) for word in text.split())
    assert words <= 46_150


def test_the_release_is_the_same_in_every_file():
    citation, changelog = yaml.safe_load((ROOT / "CITATION.cff").read_text()), (ROOT / "CHANGELOG.md").read_text()
    version, date = re.search(r"^## (\d\S*) \((\S+)\)$", changelog, re.M).groups()
    assert usvlearn.__version__.partition(".dev")[0] >= version
    assert (citation["version"], str(citation["date-released"])) == (version, date)


def test_links_of_the_pages_outside_of_the_site_lead_somewhere():
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "aboard/README.md"):
        path = ROOT / name
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text()):
            target = path.parent / link
            executed = target.with_suffix(".ipynb")  # of which the page is made
            assert target.exists() or executed.exists(), f"{name}: {link}"
