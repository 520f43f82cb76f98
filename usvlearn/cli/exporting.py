"""The command `usvlearn export RUN --to FORMAT`: what was learned, in the formats of other programs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError, did_you_mean, exit_on_user_error
from usvlearn.export.formats import FORMATS, file_name
from usvlearn.model.read_boats import IdentifiedBoat, read_boats
from usvlearn.runs.layout import CHECKPOINTS


def parser() -> argparse.ArgumentParser:
    """The arguments of the command."""
    width = max(map(len, FORMATS))
    found = argparse.ArgumentParser(
        prog="usvlearn export",
        usage="usvlearn export RUN --to FORMAT[,FORMAT …] [--boat NAME] [--out FOLDER]",
        description="Write what was learned of each boat, in the formats of other programs.",
        epilog="formats:\n" + "\n".join(f"  {name:{width}}  {each.what}" for name, each in FORMATS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    found.add_argument("run", metavar="RUN", help="the folder of a run or of a node, or a parameter set")
    found.add_argument("--to", required=True, metavar="FORMAT", help=f"one or several of {', '.join(FORMATS)}, or all")
    found.add_argument("--boat", metavar="NAME", help="only this boat")
    found.add_argument("--out", metavar="FOLDER", help="where the files are written; RUN/export if it is left out")
    return found


def formats_of(given: str) -> list[str]:
    """The formats of `--to`.

    Raises:
        ConfigError: there is no such format.

    >>> formats_of("json,c")
    ['json', 'c']
    """
    names = [*FORMATS] if given == "all" else [each.strip() for each in given.split(",") if each.strip()]
    for name in names or [given]:
        if name not in FORMATS:
            hint = did_you_mean(name, FORMATS)
            raise ConfigError(f"--to: found {name!r}, expected one of {', '.join(FORMATS)}, or all{hint}")
    return list(dict.fromkeys(names))


def run_of(path: Path) -> Path:
    """The folder of the run to which a set or a boat's folder belongs; else the folder itself, or that of the set."""
    folder = path if path.is_dir() else path.parent
    return folder.parent.parent if folder.parent.name == CHECKPOINTS else folder


def export(boats: Sequence[IdentifiedBoat], formats: Sequence[str], run: Path, out: Path) -> list[Path]:
    """Write the files, once all of them could be made; returns their paths.

    Args:
        boats: of `read_boats`.
        formats: names.
        run: the folder of the run, which has the predictions.
        out: the folder of the files, which is made.

    Raises:
        UsvlearnError: a boat lacks something, two boats' files would have one name, or a package is not installed.
        OSError: the disk is full, or the like; no file is half-written.
    """
    made: dict[Path, bytes] = {}
    for boat in boats:
        for name in formats:
            for end, content in FORMATS[name].files(boat, run).items():
                path = out / file_name(boat.name, end)
                if path in made:
                    raise ConfigError(
                        f"{path}: found two boats whose files would have this name, one of them {boat.name}: give "
                        "each by --boat, with another --out"
                    )
                made[path] = content
    out.mkdir(parents=True, exist_ok=True)
    for path, content in made.items():
        write_atomically(path, content)
    return list(made)


def main() -> int:
    """The command; returns the exit code."""
    with exit_on_user_error():
        given = parser().parse_args(sys.argv[1:])
        path, formats = Path(given.run).expanduser(), formats_of(given.to)
        boats = read_boats(path, given.boat)
        run = run_of(path)
        out = run / "export" if given.out is None else Path(given.out).expanduser()
        for each in export(boats, formats, run, out):
            print(each)
        for boat in boats:
            for sentence in boat.found.lacks:
                print(f"{boat.name}: {sentence}", file=sys.stderr)
    return 0
