"""The command `usvlearn inspect LOG…`: what logs hold, which channel is which, and a configuration that reads them."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from usvlearn.core.unconfirmed import SECTION
from usvlearn.errors import ConfigError

if TYPE_CHECKING:
    from usvlearn.logs.inspection.inspected import Inspected

USAGE = (
    "usage: usvlearn inspect LOG…\n       [--output my_boat.yaml] [--name BOAT] [--plot] [--force] [--all]\n"
    "       [--any-vehicle]\n       usvlearn inspect --confirm KEY[,KEY …] my_boat.yaml"
)

LONG = 2.0  # h of logs


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("usvlearn inspect", description=__doc__, usage=USAGE.removeprefix("usage: "))
    parser.add_argument("logs", nargs="+", metavar="LOG", help="a log, a folder of logs, or a pattern in quotes")
    parser.add_argument("--output", default="my_boat.yaml", help="the configuration to write (my_boat.yaml)")
    parser.add_argument("--name", help="of the boat, by default that of the log or its folder")
    parser.add_argument("--plot", action="store_true", help="also draw the channels, beside the configuration (.png)")
    parser.add_argument("--force", action="store_true", help="replace the configuration if it exists")
    parser.add_argument("--any-vehicle", action="store_true", help="take logs that say that they are of no boat, too")
    parser.add_argument("--all", action="store_true", help="also list all series, and the reason of each decision")
    parser.add_argument(
        "--confirm", action="append", metavar="KEY", help="say that a guess in a configuration is right; all: each"
    )
    return parser


def work(arguments: Sequence[str]) -> None:
    """Inspect, print, and write."""
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    options = parser().parse_args(list(arguments))
    if options.confirm:
        from usvlearn.logs.inspection.questions import confirm

        return terminal.show(*confirm(options.logs, options.confirm))
    with Activity(console := terminal.console(), "loading"):
        from usvlearn.core.checkpoint import write_atomically
        from usvlearn.logs.inspection import table_view
        from usvlearn.logs.inspection.inspected import inspect_logs
    output = Path(options.output).expanduser()
    if output.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--output: found {options.output!r}, expected a name that ends in .yaml")
    if "${" in str(output.resolve()):
        raise ConfigError(f"--output: found {str(output)!r}, in which Hydra takes '${{' for a reference: rename it")
    for file in (output, *([output.with_suffix(".png")] if options.plot else [])):
        if file.exists() and not options.force:
            raise ConfigError(f"--output: {file} exists: give another name, or --force to replace it")
    if not output.parent.is_dir():
        raise ConfigError(f"--output: found no folder {output.parent}: make it, or name another file")
    if options.name is not None and (options.name in ("", ".", "..") or set(options.name) & set("/\\")):
        raise ConfigError(f"--name: found {options.name!r}, expected one that can name a folder")
    if options.name is not None and ("${" in options.name or options.name == "???"):
        raise ConfigError(f"--name: found {options.name!r}, which a configuration takes for a reference: change it")
    if options.plot:
        from usvlearn.display.figures import themed

        with themed():  # refuses now, before anything is written, where matplotlib is missing
            pass
    with Activity(console, "reading, and comparing the channels with each other"):
        inspected = inspect_logs(options.logs, options.name, options.output, options.any_vehicle)
    table_view.show(inspected, options.output, console, options.all)
    check_complete(inspected, options.logs[0])
    write_atomically(output, inspected.text.encode())
    if options.plot:
        from usvlearn.logs.inspection.figure import draw

        draw(inspected, output.with_suffix(".png"))
    with Activity(console, "fitting"):
        verdict = list(_verdict(inspected, output))
    terminal.show(*verdict, "", *_end(inspected, output, options.plot))


def _verdict(inspected: Inspected, output: Path) -> Iterator[str]:
    """What the logs are good for; of long logs, whose fit takes a while, the command that tells it."""
    from usvlearn.logs.inspection.table_view import hours
    from usvlearn.model.fit.verdict import verdicts

    if hours(inspected.recordings) > LONG:
        yield f"What these logs are good for: usvlearn check {shlex.quote(str(output))}"
    elif inspected.recordings:
        yield from verdicts(inspected.recordings, inspected.settings, inspected.findings, inspected.settings[SECTION])


def check_complete(inspected: Inspected, log: str) -> None:
    """Raise a ConfigError if a required channel is missing, or a name cannot stand in a configuration."""
    if inspected.proposal.missing:
        raise ConfigError(
            f"{log}: found no {', '.join(inspected.proposal.missing)}, so that nothing was written: "
            f"{inspected.proposal.unfit or _what_to_do(inspected)}"
        )
    if "${" in json.dumps(inspected.settings):
        raise ConfigError(
            f"{log}: found '${{' in the name of a file or a series, which a configuration takes for a "
            "reference: rename it"
        )


def _what_to_do(inspected: Inspected) -> str:
    """What a person can do where a required channel was not found."""
    from usvlearn.composition.configuration import configs_folder

    reader, files = inspected.logs.reader, inspected.logs.files
    name = "topics" if files[0].is_dir() and hasattr(reader, "files") else inspected.logs.format.example
    others = len(files) == 1 and files[0].suffix.lower() == ".csv" and len(list(files[0].parent.glob("*.csv"))) > 1
    first = "if another table of its folder has them, give the folder; else " if others else ""
    return (
        f"{first}copy {configs_folder() / 'data' / name}.yaml to my_boat.yaml, set its data.path, and name the series "
        "in it (usvlearn inspect --all lists them)"
    )


def _end(inspected: Inspected, output: Path, plot: bool) -> Iterator[str]:
    from usvlearn.logs.inspection.config_writer import shell_override
    from usvlearn.logs.inspection.table_view import hours

    yield f"Read back: {len(runs := inspected.recordings)} run{'s' * (len(runs) > 1)}, {hours(runs):.2f} h."
    if plot:
        yield f"Picture: {output.with_suffix('.png')}"
    yield f"Written: {output}. To use it:"
    yield f"    usvlearn train {shell_override(str(output))}"
