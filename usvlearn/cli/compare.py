"""The command `usvlearn compare RUN RUN …`: did the boat change, and which run predicts better."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from usvlearn.cli.plain_command import out_folder, without_key

if TYPE_CHECKING:
    from usvlearn.display.terminal import ResultTable

USAGE = "usage: usvlearn compare RUN RUN … [--boat NAME] [--out FOLDER]; more: usvlearn compare --help"


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("usvlearn compare", description=__doc__)
    parser.add_argument(
        "runs", metavar="RUN", nargs="+", type=without_key, help="folders of runs, the earlier one first"
    )
    parser.add_argument("--boat", help="only this one")
    parser.add_argument("--out", metavar="FOLDER", default="comparison", help="of the page (comparison)")
    return parser


def work(arguments: Sequence[str]) -> None:
    """Compare the runs, print, and write the page and the picture for TensorBoard."""
    given = parser().parse_intermixed_args(list(arguments))
    folder = out_folder(given.out)
    from usvlearn.display.tensorboard import TensorBoardWriter
    from usvlearn.display.terminal import console, show
    from usvlearn.report.page import check_report_folder, write_report
    from usvlearn.report.side_by_side import read_boats, sections
    from usvlearn.runs.files import TENSORBOARD

    parts = sections(read_boats(given.runs, given.boat))
    check_report_folder(folder)
    for section in parts:
        for sheet in section.sheets:
            console().print(_table(section.title, sheet))
        show(*section.here, "")
    with TensorBoardWriter(folder / TENSORBOARD) as writer:
        for section in parts:
            for drawn in section.figures:
                writer.figure(f"comparison/{section.title}", drawn.figure, 0)
    index = write_report(folder, [], parts, [f"usvlearn compare {' '.join(given.runs)}"], heading="Runs compared")
    show(f"page: {index}", f"TensorBoard: tensorboard --logdir {folder}")


def _table(title: str, sheet: ResultTable):
    """Rows by verdict, what has changed first; coefficients of the model, which trade, are in the page alone."""
    from usvlearn.display.terminal import Blocks
    from usvlearn.estimators.joint.periodic_estimates import shown
    from usvlearn.estimators.regressors.terms import SURGE as COEFFICIENTS
    from usvlearn.report.side_by_side import VERDICTS

    pairs, places = len({row[0] for row in sheet.rows}) > 1, [sheet.columns.index(x) for x in ("before", "verdict")]
    numbers, last = places
    names = sheet.columns[0 if pairs else 1 : numbers]
    table = Blocks(title, names, ["before", "after", f"change {sheet.columns[numbers + 3].removeprefix('from ')}"])
    for verdict in VERDICTS:
        rows = [row for row in sheet.rows if row[last] == verdict and row[1] not in COEFFICIENTS]
        if rows:
            table.group(verdict)
        for row in rows:
            before, after, change, low, high = (
                shown(float("nan") if x is None else float(x)) for x in row[numbers:last]
            )
            table.add(*map(str, row[numbers - len(names) : numbers]), before, after, f"{change} ({low} to {high})")
    return table
