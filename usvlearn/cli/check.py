"""The command `usvlearn check LOG…`: what logs are good for, and what is missing, in at most five lines a boat."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

USAGE = "usage: usvlearn check LOG… [--name BOAT] [--any-vehicle]\n       usvlearn check my_boat.yaml"

EPILOG = "The test manoeuvre of ten minutes is in docs/controller.md; usvlearn plan designs one for a boat."


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "usvlearn check", description=__doc__, usage=USAGE.removeprefix("usage: "), epilog=EPILOG
    )
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help="a log, a folder, a pattern in quotes, or a configuration (.yaml)"
    )
    parser.add_argument("--name", help="of the boat, by default that of the log or its folder")
    parser.add_argument("--any-vehicle", action="store_true", help="take logs that say that they are of no boat, too")
    return parser


def work(arguments: Sequence[str]) -> None:
    """Read, fit, and print; nothing is written."""
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    given = parser().parse_args(list(arguments))
    with Activity(terminal.console(), "loading"):
        from usvlearn.cli.inspect import check_complete
        from usvlearn.composition.alignment import CheckedAlignment
        from usvlearn.composition.configuration import recordings_of
        from usvlearn.composition.data_files import SUFFIXES
        from usvlearn.core.unconfirmed import SECTION, open_questions
        from usvlearn.logs.inspection.inspected import inspect_logs
        from usvlearn.model.fit.verdict import verdicts

        if len(given.logs) == 1 and Path(given.logs[0]).suffix in SUFFIXES:
            lazy, settings = recordings_of(given.logs[0], {})
            recordings, checked = list(lazy), CheckedAlignment({**settings, "check": "warn"})
            checked(recordings, **settings["align"])
            findings, asked = checked.findings or [], open_questions(settings)
        else:
            inspected = inspect_logs(given.logs, given.name, any_vehicle=given.any_vehicle)
            check_complete(inspected, given.logs[0])
            settings, recordings, findings = inspected.settings, inspected.recordings, inspected.findings
            asked = settings[SECTION]
        lines = list(verdicts(recordings, settings, findings, asked))
    terminal.show(*lines)
