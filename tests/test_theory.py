"""The numbered equations of docs/theory, and that whoever cites a section or an equation of it finds it there."""

import re
from collections.abc import Iterator
from pathlib import Path

from tests.support import ROOT, over

THEORY = ROOT / "docs" / "theory"
FOLDERS = ("usvlearn", "certify", "benchmarks", "tests", "configs", "docs")
CITED = re.compile(r"docs/theory/([a-z_]+\.md)(?:#([\w-]+))?")
HEADING = re.compile(r"^#+ .*?(?:\{#([\w-]+)\})?[ \t]*$")


def sections(text: str) -> dict[str, list[str]]:
    """The numbers of a page's formulas by section."""
    numbers: dict[str, list[str]] = {}
    here, formula, fenced = "", False, False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif fenced:
            continue
        elif line.strip() == "$$":
            formula = not formula
        elif formula:
            for number in re.findall(r"\\tag\{(\d+)\}", line):
                assert here, f"({number}) stands in no section with an id"
                numbers[here].append(number)
        elif (heading := HEADING.match(line)) and heading[1]:
            here = heading[1]
            assert here not in numbers, f"#{here} occurs twice"
            numbers[here] = []
    assert not formula, "a formula has no end"
    return numbers


PAGES = {path.name: sections(path.read_text()) for path in sorted(THEORY.glob("*.md"))}


def citations() -> Iterator[tuple[Path, str, str]]:
    """File, page and section of each citation."""
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*")):
        if path.suffix in {".py", ".yaml", ".md", ".ipynb"} and path != Path(__file__):
            for page, section in CITED.findall(path.read_text()):
                yield path, page, section


def test_every_section_of_the_theory_that_is_cited_exists():
    cited = list(citations())
    for path, page, section in cited:
        assert page in PAGES, f"{path}: cites {page}, and there are {', '.join(PAGES)}"
        assert not section or section in PAGES[page], f"{path}: {page} has no section #{section}"
    assert len(cited) > 30


def test_no_source_cites_a_theory_without_naming_its_file():
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        if path != Path(__file__):
            assert not re.search(r"\(theory[, ]|docs/theory\.md`", path.read_text()), path


@over("page", PAGES)
def test_numbers_of_equations_count_from_one(page):
    for section, numbers in PAGES[page].items():
        assert numbers == [str(k + 1) for k in range(len(numbers))], f"{page}#{section}"


@over("page", PAGES)
def test_every_equation_that_a_page_cites_exists(page):
    text = (THEORY / page).read_text()
    for target, anchor in re.findall(r"\]\(([\w/.]*?\.md)?#([\w-]+)\)", text):
        if target and target not in PAGES:
            continue
        there = PAGES[target or page]
        section, _, number = anchor.rpartition("-")
        exists = anchor in there or (number.isdigit() and number in there.get(section, []))
        assert exists, f"{page}: {target or page} has no #{anchor}"
    prose = re.sub(r"^```.*?^```$|^\$\$$.*?^\$\$$|\$[^$]+\$|\[[^\]]*\]\([^)]*\)", "", text, flags=re.M | re.S)
    first, *others = re.split(r"^#+ .*?\{#([\w-]+)\}[ \t]*$", prose, flags=re.M)
    for section, written in [("", first), *zip(others[::2], others[1::2], strict=True)]:
        for number in re.findall(r"(?<!` )(?<![\w`])\((\d\d?)\)", written):  # behind a key it is a default
            assert number in PAGES[page].get(section, []), f"{page}#{section} speaks of ({number}) and has none"
