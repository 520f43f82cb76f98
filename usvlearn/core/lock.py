"""A lock on a folder, so that one process at a time writes there. The system releases it when the process ends.

The process locks the file `.lock` in the folder, which contains its number, and removes it on release. A file that a
killed process has left is not locked, and is reused.
"""

from __future__ import annotations

import atexit
import os
import stat
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path

from usvlearn.errors import ConfigError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

NAME = ".lock"
PERIOD = 0.002  # s between two attempts to lock


class Lock:
    """Holds the lock of a folder, which is made, until `release`, the end of a `with`, or the end of the process.

    `other` is the setting that names another folder, for the ConfigError where another process holds it; unless this
    one may `wait`. Processes that share it may hold it together.
    """

    def __init__(self, folder: Path, other: str, shared: bool = False, wait: bool = False):
        self.path, self._process = folder / NAME, os.getpid()
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            file = _opened(self.path)
            try:
                _lock(file, shared)
            except (BlockingIOError, PermissionError):
                if wait:
                    os.close(file)
                    time.sleep(PERIOD)
                    continue
                holder = os.read(file, 20).decode(errors="replace").strip()
                os.close(file)
                holder = f"process {holder}" if holder else "another process"
                raise ConfigError(
                    f"{folder}: {holder} is writing there: wait for its end, or choose another {other}"
                ) from None
            except OSError as error:  # a file system without locks
                warnings.warn(
                    f"{folder}: cannot be locked ({error.strerror}): let no other process write there", stacklevel=2
                )
            if self._is_current(file):
                break
            os.close(file)  # another process has just removed it
        self._file: int | None = file
        os.ftruncate(file, 0)
        os.write(file, str(self._process).encode())
        atexit.register(self.release)

    def release(self) -> None:
        """Give the lock back; a second time does nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        atexit.unregister(self.release)
        if os.getpid() == self._process:  # a forked process has a copy of a lock that belongs to its parent
            try:
                _lock(file, shared=False)  # the last process that shares it removes the file
                self.path.unlink(missing_ok=True)
            except OSError:  # still shared, or open on Windows: the file stays
                pass
        os.close(file)

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _is_current(self, file: int) -> bool:
        """Whether the locked file is still the one of that name."""
        try:
            return os.path.samestat(os.fstat(file), os.stat(self.path))
        except FileNotFoundError:
            return False


def _opened(path: Path) -> int:
    """Open the lock's file. A folder may come from anybody, so the target of a link there must not be overwritten."""
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(path.lstat().st_mode):
            raise ConfigError(f"{path}: found a link, a folder or the like, expected a regular file: remove it")
    return os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _lock(file: int, shared: bool) -> None:
    """Lock an open file; raises BlockingIOError or PermissionError if another process holds it."""
    if sys.platform != "win32":
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    elif not shared:  # Windows has no shared locks, so processes that share do not lock
        os.lseek(file, 1 << 30, os.SEEK_SET)  # a byte after the content, so that others can read the content
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        os.lseek(file, 0, os.SEEK_SET)
