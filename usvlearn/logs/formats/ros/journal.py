"""An SQLite bag that its recorder has not closed: `X.db3-wal` holds messages that are not in `X.db3` yet.

The package rosbags reads the database alone. Here both are copied and joined; the files of the bag stay as they are.
"""

from __future__ import annotations

import shutil
import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

from usvlearn.errors import LogFormatError

JOURNALS = "-wal", "-journal"  # a rollback journal takes back what was half written


@contextmanager
def joined_journals(files: list[Path]) -> Iterator[list[Path]]:
    """The files, with a joined copy in place of each database that has a journal, as a context.

    A database and its journal that cannot be copied or joined are a LogFormatError.
    """
    beside = {file: [file.with_name(file.name + end) for end in JOURNALS] for file in files if file.suffix == ".db3"}
    left = {file: [each for each in some if each.is_file() and each.stat().st_size] for file, some in beside.items()}
    with TemporaryDirectory() if any(left.values()) else nullcontext("") as folder:
        yield [_join(file, left[file], Path(folder)) if left.get(file) else file for file in files]


def _join(file: Path, journals: list[Path], folder: Path) -> Path:
    """A copy of a database, joined with its journals."""
    name = journals[0].name
    try:
        for each in (file, *journals):
            shutil.copyfile(each, folder / each.name)
        with closing(sqlite3.connect(folder / file.name)) as base:
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            base.execute("SELECT count(*) FROM sqlite_master").fetchall()  # this takes back what a -journal holds
    except (OSError, sqlite3.Error) as error:
        raise LogFormatError(
            f"{file}: found {name} beside it, which holds messages that are not in the bag, and could not join them "
            f"({error}): run `sqlite3 {file.name} 'PRAGMA wal_checkpoint'` on a copy of both"
        ) from error
    warnings.warn(f"{file}: its recorder has not closed it: read together with {name}, from a copy", stacklevel=7)
    return folder / file.name
