"""Tables that are no plain text: compressed, or of a spreadsheet, Parquet, MATLAB or NumPy. Their text is read."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from usvlearn.errors import LogFormatError, printable

PACKED = (".csv.gz", ".tsv.gz", ".xlsx", ".parquet", ".mat", ".npz")
ELEMENTS = 16  # columns of a matrix, at most


def open_table(path: Path) -> BinaryIO:
    """The text of a table, as bytes; a LogFormatError if it is damaged, or a package that reads it is missing."""
    if not path.name.lower().endswith(PACKED):
        return path.open("rb")
    return io.BytesIO(_unpacked(path, path.stat().st_mtime_ns, path.stat().st_size))


@lru_cache(maxsize=2)  # a table is opened several times: to find its columns, its stamps, its numbers
def _unpacked(path: Path, *state: int) -> bytes:
    try:
        return _text(path, path.suffix.lower())
    except ImportError as error:
        what = f'a table that {error.name} reads: pip install "usvlearn[tables]", or save it as CSV'
    except NotImplementedError:
        what = "MATLAB 7.3 (HDF5): save(FILE, '-v7'), or writetable to CSV"
    except Warning:
        raise
    except Exception as error:  # other packages raise anything
        what = f"{printable(' '.join(str(error).split())[:100])!r} while it was unpacked: save it as CSV"
    raise LogFormatError(f"{path}: found {what}")


def _text(path: Path, suffix: str) -> bytes:
    if suffix == ".gz":
        return gzip.decompress(path.read_bytes())
    if suffix in (".xlsx", ".parquet"):
        import pandas  # pyright: ignore[reportMissingImports]

        if suffix == ".parquet":
            frame = pandas.read_parquet(path)
            return frame.to_csv(index=frame.index.name is not None).encode()
        sheets = pandas.read_excel(path, sheet_name=None, header=None)
        most = max(sheets, key=lambda name: len(sheets[name]))
        _tell(path, [name for name, sheet in sheets.items() if name != most and len(sheet)], f"the sheet {most!r}")
        return sheets[most].to_csv(index=False, header=False).encode()
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            columns = dict(_columns("", dict(file)))
    else:
        from scipy.io import loadmat

        columns = dict(_columns("", loadmat(path, simplify_cells=True)))
    rows, _ = Counter(len(each) for each in columns.values() if each is not None).most_common(1)[0]
    complete = {name: each.tolist() for name, each in columns.items() if each is not None and len(each) == rows}
    _tell(path, [name for name in columns if name not in complete], f"the arrays of {rows} numbers")
    csv.writer(text := io.StringIO()).writerows([[*complete], *zip(*complete.values(), strict=True)])
    return text.getvalue().encode()


def _columns(name: str, value: Any) -> Iterator[tuple[str, np.ndarray | None]]:
    """The columns of arrays and structures; None for what is none."""
    if isinstance(value, dict):
        for key in [each for each in value if not each.startswith("__")]:
            yield from _columns(f"{name}.{key}".lstrip("."), value[key])
        return
    array = np.squeeze(value) if isinstance(value, np.ndarray) and value.dtype.kind in "fiubUM" else np.zeros((0, 0))
    if array.ndim == 2 and 0 < array.shape[1] <= ELEMENTS:
        yield from ((f"{name}[{k}]", array[:, k]) for k in range(array.shape[1]))
    else:
        yield name, array if array.ndim == 1 else None


def _tell(path: Path, names: list[str], read: str) -> None:
    if names:
        listed = printable(", ".join(names[:8])) + (", …" if len(names) > 8 else "")
        warnings.warn(f"{path}: reads {read}, but not {listed}: save these as CSV to read them", stacklevel=2)
