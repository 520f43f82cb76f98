"""Waits for all submitit jobs, on Slurm or here. A killed job gets the objective NaN.

Submitit raises an error for the first job that left no result, while others still run. Here the job is noted, its
objective is NaN, and the others are waited for. Submitit asks `sacct` which jobs have ended. That needs a database,
which not every cluster has, and without it a killed job would be waited for without end. Here `squeue` is asked.
"""

from __future__ import annotations

import os
import sys
from functools import wraps
from typing import Any

from hydra.core.utils import JobReturn, JobStatus

PERIOD = 60  # s between two questions to Slurm, at most; results are files, and are seen without a question
QUEUE = ["squeue", "--noheader", "--array", "--format=%i"]  # the numbers of the jobs that have not ended
NUMBER = 2  # the place of a job's number among the arguments of Hydra's launcher


def wait_for_all(lost: list[int]) -> None:
    """Let the launchers of submitit wait until every job has ended.

    Args:
        lost: receives the number of each job whose process ended without a result.
    """
    from submitit.core.core import Job
    from submitit.core.utils import FailedJobError, UncompletedJobError
    from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

    class Queue(SlurmInfoWatcher):
        def _make_command(self) -> list[str] | None:
            return [*QUEUE, f"--user={os.getuid()}"] if self._registered - self._finished else None

        def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
            queued = (string if isinstance(string, str) else string.decode()).split()
            return {job: {"State": "RUNNING" if job in queued else "ENDED"} for job in self._registered}

    results = getattr(Job.results, "__wrapped__", Job.results)

    @wraps(results)
    def results_or_nan(job: Job) -> list[Any]:
        try:
            return results(job)
        except (UncompletedJobError, FailedJobError):
            number = job.submission().args[NUMBER]
            lost.append(number)
            print(f"error: job {number}: its process has ended before the job: see {job.paths.stderr}", file=sys.stderr)
            return [JobReturn(status=JobStatus.COMPLETED, _return_value=float("nan"))]

    job_class: Any = Job  # a type checker allows no other method in the place of one
    job_class.results = results_or_nan
    SlurmJob.watcher = Queue(PERIOD)
