"""The command `usvlearn export RUN --to FORMAT`: what was learned, in the formats of other programs."""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from usvlearn.cli.plain_command import out_folder, without_key
from usvlearn.core.checkpoint import write_atomically
from usvlearn.errors import ConfigError, UsvlearnError, complain, did_you_mean, printable
from usvlearn.model.export.formats import FORMATS, Files, file_name
from usvlearn.model.export.planar_boat import PlanarBoat, read_planar
from usvlearn.model.read_boats import IdentifiedBoat, read_boats
from usvlearn.runs.files import CHECKPOINTS, PLANAR

ALL = "all"

PLANAR_TOO = "\n\n{} also write the planar model, BOAT_planar, of a run that learned sway and yaw rate".format(
    ", ".join(name for name, each in FORMATS.items() if each.planar is not None)
)
USAGE = "usage: usvlearn export RUN --to FORMAT[,FORMAT …]\n       [--boat NAME] [--out FOLDER] [--force]"


def parser() -> argparse.ArgumentParser:
    """The arguments of the command."""
    width = max(map(len, FORMATS))
    parser = argparse.ArgumentParser(
        prog="usvlearn export",
        usage=USAGE.removeprefix("usage: "),
        description="Write what was learned of each boat, in the formats of other programs.",
        epilog="formats:\n"
        + "\n".join(f"  {name:{width}}  {each.what}" for name, each in FORMATS.items())
        + PLANAR_TOO,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run", metavar="RUN", type=without_key, help="folder of a run or of a node, or a checkpoint")
    formats = f"one or several of {', '.join(FORMATS)}; all: those that the run has and that are installed"
    parser.add_argument("--to", required=True, action="append", metavar="FORMAT", help=formats)
    parser.add_argument("--boat", metavar="NAME", help="only this boat")
    parser.add_argument("--out", metavar="FOLDER", help="where the files are written; RUN/export if it is left out")
    parser.add_argument("--force", action="store_true", help="also write a boat that is not physical: wrong signs")
    return parser


def formats_of(given: Sequence[str]) -> list[str]:
    """What all `--to` name, of which each may have several, comma-separated: formats, or `ALL`."""
    names = [each.strip() for part in given for each in part.split(",") if each.strip()]
    for name in names or [""]:
        if name not in (*FORMATS, ALL):
            hint = did_you_mean(name, FORMATS)
            raise ConfigError(f"--to: found {name!r}, expected one of {', '.join(FORMATS)}, or {ALL}{hint}")
    return list(dict.fromkeys(names))


def run_of(path: Path) -> Path:
    """The folder of the run to which a checkpoint or a boat's folder belongs; else the path's own folder."""
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    return folder.parent.parent if folder.parent.name == CHECKPOINTS else (path if path.is_dir() else path.parent)


def export(
    boats: Sequence[IdentifiedBoat], formats: Sequence[str], run: Path, out: Path, lenient: bool = False
) -> list[Path]:
    """Write the files, once all of them could be made; if `lenient`, those that can be, with a warning."""
    files_made: dict[Path, bytes] = {}
    for boat in boats:
        for what, make in _makers(boat, formats, run).items():
            try:
                files = {out / file_name(boat, end): content for end, content in make().items()}
            except UsvlearnError as error:
                if not lenient:
                    raise
                warnings.warn(f"{what} of {printable(boat.name)} is left out: {error}", stacklevel=2)
                continue
            if twice := files_made.keys() & files.keys():
                raise ConfigError(
                    f"--boat: found two boats whose files would have one name, {min(twice).name}: give one of them, "
                    "and another folder for the files of each"
                )
            files_made |= files
    out.mkdir(parents=True, exist_ok=True)
    for path, content in files_made.items():
        write_atomically(path, content)
    return list(files_made)


def _makers(boat: IdentifiedBoat, formats: Sequence[str], run: Path) -> dict[str, Callable[[], Files]]:
    """What makes the files of a boat, by what they are, in words."""
    makers: dict[str, Callable[[], Files]] = {name: partial(FORMATS[name].files, boat, run) for name in formats}
    planar = [each for name in formats if (each := FORMATS[name].planar) is not None]
    return makers | ({"the planar model": partial(_planar_files, planar, boat, run)} if planar else {})


def _planar_files(makers: Sequence[Callable[[PlanarBoat], Files]], boat: IdentifiedBoat, run: Path) -> Files:
    planar = read_planar(boat, run)
    if planar is None:
        return {}
    for sentence in planar.lacks[len(boat.guessed) :]:
        complain(f"{printable(boat.name)}: {sentence}")
    return {end: content for make in makers for end, content in make(planar).items()}


def work(arguments: Sequence[str]) -> None:
    """Do what the arguments say."""
    given = parser().parse_args(arguments)
    formats = formats_of(given.to)
    out = None if given.out is None else out_folder(given.out)
    run = run_of(path := Path(os.path.expanduser(given.run)))
    if run.resolve().name == PLANAR and (whole := run.resolve().parent / CHECKPOINTS).is_dir():
        raise ConfigError(f"{path}: found the part of a run that learned sway and yaw rate: give {whole.parent}")
    boats = read_boats(path, given.boat)
    for boat in () if given.force else boats:
        boat.check_physical(" To write it all the same, add --force.")
    every = ALL in formats
    for each in export(boats, [*FORMATS] if every else formats, run, out or run / "export", lenient=every):
        print(each)
    for boat in boats:
        for sentence in boat.lacks:
            complain(f"{printable(boat.name)}: {sentence}")
