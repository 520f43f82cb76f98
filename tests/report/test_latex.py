"""What a paper needs: figures at the width of a column, tables, the model as an equation; and it compiles."""

import re
import shutil
import subprocess
from types import SimpleNamespace

import pytest

from usvlearn.display.figures import themed
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.model.surge import WITHOUT_EVEN, SurgeModel
from usvlearn.report.latex import COLUMN, MOST, PAGE, equation, escaped, latex_table, write_latex
from usvlearn.report.sections.section import Drawn, Section


def boat(name="heron_1"):
    numbers = {**dict.fromkeys(WITHOUT_EVEN, 0.0), "drag_quadratic": -7.25, "thrust_linear_left": 28.0}
    return SimpleNamespace(name=name, stem=name, model=SurgeModel(36.0, numbers))


def section(width):
    with themed() as Figure:
        figure = Figure(figsize=(width, 2))
        figure.subplots().set_title("50 % of a_b", fontsize=7)
    table = ResultTable("online", ("boat", "error, m/s"), [("a & b_1", 0.123456), ("Ölboot – 漢", None)])
    return Section("online", "Errors", "", [], [Drawn(f"drawn {width}", figure, "Skill in %.")], [table])


@pytest.fixture
def written(tmp_path):
    known = {"heron_1": {"time_constant": Quantity(1.62, 1.47, 1.78, "s"), "drag_quadratic": Quantity(1, 1, 1, "kg/m")}}
    return write_latex(tmp_path / "paper", [section(4), section(9)], known, [boat()])[0]


def test_the_equation_has_the_numbers_and_no_term_that_is_zero():
    text = equation(boat())
    assert r"36.0\,\dot v ={}&  -7.25\,|v|v + 28.0\,\xi_L" in text and r"\xi_R\,|" not in text and "F_i" not in text


def test_figures_have_the_width_of_a_column_or_of_a_page(written):
    for name, width in (("drawn_4", COLUMN), ("drawn_9", PAGE)):
        svg = (written.parent / f"{name}.svg").read_text()
        assert float(re.search(r'width="([\d.]+)pt"', svg)[1]) == pytest.approx(72 * width, rel=1e-3)
        assert (written.parent / f"{name}.pdf").read_bytes().startswith(b"%PDF")


def test_tables_have_intervals_units_and_no_special_letters(written):
    table = (written.parent / "table_parameters_heron_1.tex").read_text()
    assert r"time constant & 1.62 & 1.47 \dots{} 1.78 & s" in table and "drag" not in table
    online = (written.parent / "table_online.tex").read_text()
    assert r"a \& b\_1 & 0.1235" in online and "Ölboot -- ? & --" in online
    assert escaped("~^\\") == r"\textasciitilde{}\textasciicircum{}\textbackslash{}"
    rest = latex_table(ResultTable("long", ("x",), [(k,) for k in range(MOST + 7)]))
    assert "7 more rows in tables/long.csv" in rest and rest.count(r"\\") == MOST + 2


@pytest.mark.thorough
def test_it_compiles(written):
    if shutil.which("pdflatex") is None:
        pytest.skip("needs pdflatex")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", written.name]
    done = subprocess.run(command, cwd=written.parent, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]
    assert written.with_suffix(".pdf").stat().st_size > 10_000
