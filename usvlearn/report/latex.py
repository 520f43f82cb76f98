"""A report for a paper: figures at the width of a column, tables and the model as LaTeX, and what to cite."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import write_atomically
from usvlearn.display.figures import themed
from usvlearn.display.terminal import ResultTable
from usvlearn.display.terminal import shown as digits
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import shown
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.report.sections.section import Section

COLUMN, PAGE, LEAST = 3.5, 7.16, 6.0  # inches: widths of a column and of a page (IEEE); points: the smallest letters
NARROW = 5.0  # inches: a figure that was drawn narrower is put into a column
MOST, BROAD = 40, 6  # rows of a table; columns, from which on it is fitted to the page
TABLES = ("online", "forecast", "tracks", "fit_missions", "certificates")  # those that papers show
SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "°": r"\ensuremath{^\circ}",
    "µ": r"\ensuremath{\mu}", "–": "--", "−": r"\ensuremath{-}", "±": r"\ensuremath{\pm}", "…": r"\dots{}",
    "²": r"\textsuperscript{2}", "→": r"\ensuremath{\to}", "≤": r"\ensuremath{\le}",
} | {x: "\\" + x for x in "&%$#_{}"}  # fmt: skip
TERMS = {  # of the surge model -> LaTeX; theory/model.md (1)
    "drag_quadratic": r"|v|v", "drag_linear": "v", "drag_cross": r"|r|v", "drag_even": "v^2",
} | {
    f"thrust_{kind}_{side}": term.replace("x", rf"\xi_{side[0].upper()}")
    for side in ("left", "right")
    for kind, term in {"linear": "x", "quadratic": "x|x|", "speed": "x|v|", "cubic": "x^3",
                       "even_linear": "|x|", "even_quadratic": "x^2", "even_speed": "xv"}.items()
}  # fmt: skip
CITED = r"""@article{paine2023ensemble,
  title = {An ensemble of online estimation methods for one degree-of-freedom models of unmanned surface vehicles:
    applied theory and preliminary field results with eight vehicles},
  author = {Paine, Tyler M. and Benjamin, Michael R.},
  journal = {arXiv preprint arXiv:2308.00782},
  year = {2023},
  doi = {10.48550/arXiv.2308.00782}
}
@software{usvlearn,
  title = {usvlearn},
  author = {{The usvlearn authors}},
  version = {VERSION},
  note = {Online identification of unmanned surface vehicles. MIT license}
}
"""
HEAD = r"""\documentclass[twocolumn]{article}
\usepackage[utf8]{inputenc}
\usepackage[T1]{fontenc}
\usepackage{amsmath,booktabs,graphicx}
\begin{document}
"""


def write_latex(
    folder: Path, sections: Sequence[Section], quantities: Mapping[str, Mapping[str, Quantity]],
    boats: Sequence[IdentifiedBoat],
) -> list[Path]:  # fmt: skip
    """Write `paper.tex`, which includes all, `cited.bib`, and the parts; returns the files, `paper.tex` first.

    The parts are the figures of a report's sections as PDF and SVG, tables, and the models of boats as equations.
    """
    import usvlearn

    files: dict[str, bytes] = {"cited.bib": CITED.replace("VERSION", usvlearn.__version__).encode()}
    body = [HEAD]
    for boat in boats:
        files[f"model_{_plain(boat.stem)}.tex"] = equation(boat).encode()
    tables = [_quantities(boat, known) for boat, known in quantities.items()]
    tables += [each for section in sections for each in section.sheets if each.name in TABLES and each.rows]
    for table in tables:
        files[f"table_{_plain(table.name)}.tex"] = latex_table(table).encode()
    body += [rf"\input{{{name.removesuffix('.tex')}}}" for name in files if name.endswith(".tex")]
    for drawn in (drawn for section in sections for drawn in section.figures):
        name = _plain(drawn.name)
        wide = drawn.figure.get_size_inches()[0] > NARROW
        star, width = ("*", r"\textwidth") if wide else ("", r"\columnwidth")
        for kind in ("pdf", "svg"):
            files[f"{name}.{kind}"] = _figure(drawn.figure, PAGE if wide else COLUMN, kind)
        body.append(
            rf"\begin{{figure{star}}}[t]\centering\includegraphics[width={width}]{{{name}.pdf}}"
            rf"\caption{{{escaped(drawn.caption or drawn.name)}}}\end{{figure{star}}}"
        )
    body.append("\\clearpage\n\\nocite{*}\n\\bibliographystyle{plain}\n\\bibliography{cited}\n\\end{document}\n")
    files = {"paper.tex": "\n".join(body).encode(), **files}
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomically(folder / name, content)
    return [folder / name for name in files]


def _plain(name: str) -> str:
    """A name of a file that LaTeX reads."""
    return re.sub(r"[^-A-Za-z0-9_]", "_", name)


def escaped(text: str) -> str:
    """A text for LaTeX; letters that its default fonts lack become question marks."""
    return "".join(SPECIAL.get(x, x if ord(x) < 0x180 else "?") for x in text)


def latex_table(table: ResultTable) -> str:
    """A table as `tabular` with booktabs; at most MOST rows, and a line that says what is left out."""
    align = "".join("r" if any(isinstance(row[k], int | float) for row in table.rows) else "l"
                    for k in range(len(table.columns)))  # fmt: skip
    rows = [[digits(x) for x in row] for row in table.rows[:MOST]]
    lines = [" & ".join(map(escaped, row)) + r" \\" for row in ([*table.columns], *rows)]
    left = len(table.rows) - len(rows)
    said = f"{left} more rows in tables/{escaped(table.name)}.csv"
    more = [rf"\multicolumn{{{len(align)}}}{{l}}{{{said}}} \\"] * bool(left)
    inner = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], *more, r"\bottomrule"])
    body = f"\\begin{{tabular}}{{{align}}}\n{inner}\n\\end{{tabular}}"
    if len(align) > BROAD:
        body = f"\\resizebox{{\\textwidth}}{{!}}{{%\n{body}}}"
    caption = escaped(table.name.replace("_", " "))
    return f"\\begin{{table*}}[t]\\centering\\footnotesize\n\\caption{{{caption}}}\n{body}\n\\end{{table*}}\n"


def _quantities(boat: str, quantities: Mapping[str, Quantity]) -> ResultTable:
    """The quantities of a boat, which TERMS does not have: those are in the equation."""
    rows = [
        (name.replace("_", " "), shown(each.value), f"{shown(each.low)} … {shown(each.high)}", each.unit)
        for name, each in quantities.items()
        if name not in TERMS and each.value == each.value
    ]
    return ResultTable(f"parameters_{_plain(boat)}", ("quantity", "value", "90 % interval", "unit"), rows)


def equation(boat: IdentifiedBoat) -> str:
    """The surge model of a boat with its numbers, SI units."""
    model = boat.model
    terms = [f"{shown(value)}\\,{TERMS[name]}" for name, value in model.coefficients.items() if value]
    if model.tables is not None:
        terms.append(r"\sum_i F_i(\xi_i) + \operatorname{sgn}(v)\,D(|v|)")
    signed = [f"{'' if each.startswith('-') else '+'} {each}" for each in terms]
    inner = "\\\\\n&".join(" ".join(signed[k : k + 3]) for k in range(0, len(signed), 3))
    where = " $F_i$, $D$: tables, linear between their points (\\texttt{usvlearn export})." * (model.tables is not None)
    return (
        f"\\begin{{align*}}\n{shown(model.mass)}\\,\\dot v ={{}}& {inner}\n\\end{{align*}}\n"
        f"{escaped(boat.name)}, SI units: $v$ speed ahead, $r$ yaw rate, $\\xi_L, \\xi_R$ commands, shares of full "
        f"scale; mass in kg, forces in N.{where}\n"
    )


def _figure(figure: Any, width: float, kind: str) -> bytes:
    """A figure at a width in inches, with letters of LEAST points or more."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    size, content = figure.get_size_inches().copy(), io.BytesIO()
    texts = {text: text.get_fontsize() for text in figure.findobj(Text)}
    with themed(), rc_context({"svg.fonttype": "none", "pdf.fonttype": 42}):
        try:
            figure.set_size_inches(size * width / size[0])
            for text, points in texts.items():
                text.set_fontsize(max(LEAST, points * width / size[0]))
            figure.savefig(content, format=kind, metadata={"CreationDate": None} if kind == "pdf" else {"Date": None})
        finally:
            figure.set_size_inches(size)
            for text, points in texts.items():
                text.set_fontsize(points)
    return content.getvalue()
