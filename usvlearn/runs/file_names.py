"""The files in a run's folder. Imports no torch.

checkpoints/BOAT/RRRRR_SSSSSSS.safetensors   the boat's state after S steps of its run with index R
predictions/RRRRR_SSSSSSS.npz                what was published of all boats since the previous file: predictions,
                                             half-widths of their intervals, health of the thrusters
planar/checkpoints/BOAT/                     likewise, with sway, yaw rate and tracks; the newest two
runs.json                                    names and digests of the runs, digest of the ensemble, start time, and the
                                             number of this run among the runs beside it
errors.csv                                   the errors of each run of each boat (`usvlearn.evaluation.by_run`)
tensorboard/                                 see `usvlearn.display.tensorboard`
results.json                                 the scores, written at the end; {"partial": scores} if the run was stopped
tuning.json                                  the result of a tuning, which writes none of the above
optuna.log                                   the trials of a search, written as they finish
workers/                                     locks of the processes that search together
job.json                                     the settings of a job of a sweep
.hydra/                                      the configuration and the command, which Hydra writes
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import write_atomically

CHECKPOINTS, PREDICTIONS, RUNS, RESULTS = "checkpoints", "predictions", "runs.json", "results.json"
TENSORBOARD, ERRORS, TUNING, JOURNAL = "tensorboard", "errors.csv", "tuning.json", "optuna.log"
WORKERS, JOB, HYDRA, PLANAR = "workers", "job.json", ".hydra", "planar"
ESTIMATOR = "Ensemble"  # the kind of state in a checkpoint


def save_results(folder: Path, results: Mapping[str, Any]) -> None:
    """Write `results.json`. NaN becomes null, because JSON has no NaN.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_results(Path(folder), {"objective": float("nan")})
    ...     json.loads(Path(folder, RESULTS).read_text())
    {'objective': None}
    """
    text = json.dumps(json.loads(json.dumps(results), parse_constant=lambda _: None), indent=2)
    write_atomically(folder / RESULTS, text.encode())
