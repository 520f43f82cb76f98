"""The theory in docs/theory and the modules that cite it state the same equations under the same numbers."""

import ast
import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path

from tests.support import ROOT, over

THEORY = ROOT / "docs" / "theory"
FOLDERS = ("usvlearn", "certify", "benchmarks", "tests", "configs", "docs")
CITED = re.compile(r"docs/theory/([a-z_]+\.md)(?:#([\w-]+))?")
HEADING = re.compile(r"^#+ .*?(?:\{#([\w-]+)\})?[ \t]*$")
NUMBER = re.compile(r"\s{2,}\((\d+)\)$")
RELATION = re.compile(r"[=←∝]")
# Symbols with other letters on the page (docs/theory/notation.md): section -> {in the module: on the page, "" nowhere}.
RENAMED = {
    "tuning": {"S": "X", "dx": "ϖ"},
}
NAMES = {"surge": "v", "heading": "ψ", "xi": "ξ"}  # words of docstrings in ASCII
GREEK = {
    name: unicodedata.lookup(f"GREEK {case} LETTER {name.upper()}")
    for case, names in (
        ("SMALL", "alpha beta gamma delta epsilon zeta eta theta kappa mu nu xi pi rho sigma tau phi chi psi omega"),
        ("CAPITAL", "Gamma Delta Theta Lamda Xi Sigma Phi Psi Omega Upsilon"),
    )
    for name in names.split()
} | {"lambda": "λ", "Lambda": "Λ", "varphi": "φ", "varpi": "ϖ", "varrho": "ρ"}
GREEK |= {"varsigma": "ς", "varepsilon": "ε", "vartheta": "ϑ"}
MACROS = GREEK | {"leftarrow": "←", "propto": "∝", "ell": "ℓ", "partial": "∂"}


def sections(text: str) -> dict[str, dict[str, str]]:
    r"""The numbered formulas of a page by section and number.

    >>> sections("## A {#a}\n\n$$\nx = 1 \\tag{1}\n$$\n### B {#b}\n")
    {'a': {'1': 'x = 1 '}, 'b': {}}
    """
    found: dict[str, dict[str, str]] = {}
    here, formula, fenced = "", None, False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif fenced:
            continue
        elif line.strip() == "$$" and formula is None:
            formula = []
        elif line.strip() == "$$":
            whole, formula = "\n".join(formula), None
            for number in re.findall(r"\\tag\{(\d+)\}", whole):
                assert here, f"({number}) stands in no section with an id"
                assert number not in found[here], f"#{here} has ({number}) twice"
                found[here][number] = re.sub(r"\\tag\{\d+\}", "", whole)
        elif formula is not None:
            formula.append(line)
        elif (heading := HEADING.match(line)) and heading[1]:
            here = heading[1]
            assert here not in found, f"#{here} occurs twice"
            found[here] = {}
    assert formula is None, "a formula has no end"
    return found


def left_hand(equations: str) -> set[str]:
    """The last symbol before each relation: without decoration, subscript, superscript and arguments.

    >>> sorted(left_hand("m v_dot = c_q v,   θ̂⁺ = θ,   q ← (1, x = 2)"))
    ['q', 'v', 'θ']
    """
    plain = unicodedata.normalize("NFD", re.sub(r" {3,}", "\n", equations).replace("<=", "≤").replace(">=", "≥"))
    plain = "".join(each for each in plain if unicodedata.category(each) != "Mn")
    plain = re.sub(r"_dot\b|_\{[^}]*\}|_\w+|[₀-₉₋ᵀ⁺⁻⁰¹²³⁴-⁹ᵏ'′*&]|\^\S+", " ", plain)
    for _ in range(3):
        plain = re.sub(r"[(\[][^()\[\]]*[)\]]", " ", plain)  # arguments, whose commas divide no equations
    symbols = set()
    for equation in re.split(r"[\n,;]", plain):
        before, *rest = RELATION.split(equation)
        if rest and (words := re.findall(r"[^\W\d_]+", before)):
            symbols.add(NAMES.get(words[-1], words[-1]))
    return symbols


def plain_tex(formula: str) -> str:
    r"""A TeX formula in the letters of docstrings.

    >>> sorted(left_hand(plain_tex(r"\dot{\hat\theta}^+ = 1, \qquad \bar P_{\mathcal{AA}}\,\pi_{\mathcal A} = x")))
    ['θ', 'π']
    """
    plain = re.sub(r"[_^]\\(?:text|mathrm)\s*\{[^{}]*\}", " ", formula)  # words as subscripts
    plain = re.sub(r"\\(?:text|mathrm|operatorname|mathbf|mathcal|mathbb)\s*\{([^{}]*)\}", r" \1 ", plain)
    plain = re.sub(r"\\(?:mathrm|mathcal|mathbf)\b *", "", plain)
    plain = re.sub(r"\\(?:begin|end)\{\w+\}|\\[,;:! ]|\\(?:left|right|tfrac|frac|dfrac|Big)\b[lr]?", " ", plain)
    plain = re.sub(r"\\\\(?:\[\w+\])?|\\q?quad\b", "\n", plain)
    for _ in range(3):  # subscripts and superscripts, which may be nested
        plain = re.sub(r"[_^]\s*(?:\{[^{}]*\}|\\\w+|[^\s{}\\])", " ", plain)
    plain = re.sub(r"\\(hat|bar|tilde|dot|mathring)\b", "", plain)
    plain = re.sub(r"\\([A-Za-z]+)", lambda found: f" {MACROS.get(found[1], '')} ", plain)
    # Letters side by side are a product, of which the last one counts; words come from \text.
    return re.sub(r"[{}&\t ]+", " ", plain)


def equations(path: Path) -> dict[str, str]:
    """The numbered lines of a module's docstring, by number."""
    found: dict[str, str] = {}
    for line in (ast.get_docstring(ast.parse(path.read_text())) or "").splitlines():
        if line.startswith("    ") and (number := NUMBER.search(line)):
            assert number[1] not in found, f"{path}: ({number[1]}) twice"
            found[number[1]] = line[: number.start()]
    return found


PAGES = {path.name: sections(path.read_text()) for path in sorted(THEORY.glob("*.md"))}


def citations() -> Iterator[tuple[Path, str, str]]:
    """File, page and section of each citation."""
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*")):
        if path.suffix in {".py", ".yaml", ".md", ".ipynb"} and path != Path(__file__):
            for page, section in CITED.findall(path.read_text()):
                yield path, page, section


MODULES = {
    str(path.relative_to(ROOT)): path
    for path, _, section in citations()
    if section and path.suffix == ".py" and path.is_relative_to(ROOT / "usvlearn")
}


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
    """A section that has a number twice is refused by `sections`."""
    for section, formulas in PAGES[page].items():
        assert list(formulas) == [str(k + 1) for k in range(len(formulas))], f"{page}#{section}"


@over("module", MODULES)
def test_a_module_has_the_equations_of_the_section_that_it_cites(module):
    own = equations(MODULES[module])
    cited = [(page, section) for page, section in CITED.findall(MODULES[module].read_text()) if section]
    page, section = next((each for each in cited if PAGES[each[0]][each[1]]), cited[0])
    theirs, renamed = PAGES[page][section], RENAMED.get(section, {})
    for number, line in own.items():
        assert number in theirs, f"{module}: {page}#{section} has no ({number})"
        there = left_hand(plain_tex(theirs[number]))
        for symbol in left_hand(line):
            letters = renamed.get(symbol, symbol).split()
            missing = letters and not there.intersection(letters)
            assert not missing, f"{module} ({number}) has {symbol}, {page}#{section} has {sorted(there)} there"


@over("page", PAGES)
def test_every_equation_that_a_page_cites_exists(page):
    text = (THEORY / page).read_text()
    for target, anchor in re.findall(r"\]\(([\w/.]*?\.md)?#([\w-]+)\)", text):
        if target and target not in PAGES:
            continue
        there = PAGES[target or page]
        section, _, number = anchor.rpartition("-")
        exists = anchor in there or (number.isdigit() and number in there.get(section, {}))
        assert exists, f"{page}: {target or page} has no #{anchor}"
    prose = re.sub(r"^```.*?^```$|^\$\$$.*?^\$\$$|\$[^$]+\$|\[[^\]]*\]\([^)]*\)", "", text, flags=re.M | re.S)
    first, *others = re.split(r"^#+ .*?\{#([\w-]+)\}[ \t]*$", prose, flags=re.M)
    for section, written in [("", first), *zip(others[::2], others[1::2], strict=True)]:
        for number in re.findall(r"(?<!` )(?<![\w`])\((\d\d?)\)", written):  # behind a key it is a default
            assert number in PAGES[page].get(section, {}), f"{page}#{section} speaks of ({number}) and has none"
