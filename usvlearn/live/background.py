"""Work that a node does in a thread, so that no message waits for the disk or for a check of the data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class Background:
    """Does jobs one after the other, and at most one of each name at a time."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="usvlearn-background")
        self._jobs: dict[str, Future[Any]] = {}

    def submit(self, name: str, work: Callable[..., Any], *arguments: Any) -> bool:
        """Begin a job, unless one of this name waits or has not been reported by `done`; returns whether it began."""
        if name in self._jobs:
            return False
        self._jobs[name] = self._thread.submit(work, *arguments)
        return True

    def done(self) -> Iterator[tuple[str, Any, BaseException | None]]:
        """Name, result and error of the jobs that have ended since the last call."""
        for name in [name for name, job in self._jobs.items() if job.done()]:
            job = self._jobs.pop(name)
            error = job.exception()
            yield name, None if error else job.result(), error

    def wait(self) -> None:
        """Wait until all jobs have ended."""
        for job in list(self._jobs.values()):
            job.exception()

    def close(self) -> None:
        """Wait, and end the thread."""
        self._thread.shutdown(wait=True)
