"""What a run's folder holds, by name. Imports no torch.

checkpoints/BOAT/RRRRR_SSSSSSS.safetensors   the boat's state after S steps of its run with index R
predictions/RRRRR_SSSSSSS.npz                what was published since the file before, of all boats: predictions,
                                             half-widths of their intervals, health of the thrusters
runs.json                                    which runs, of which samples, through which ensemble; when it began, and
                                             as which number among the runs beside it
results.json                                 the scores, at the end; {"partial": scores} of a run that was stopped
tuning.json                                  what tuning leaves in place of all that
optuna.log                                   the trials of a search, as they come
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from usvlearn.checkpoint import write_atomically

CHECKPOINTS, PREDICTIONS, RUNS, RESULTS = "checkpoints", "predictions", "runs.json", "results.json"
TUNING, JOURNAL = "tuning.json", "optuna.log"
ESTIMATOR = "Ensemble"  # whose state a checkpoint holds


def save_results(folder: Path, results: Mapping[str, Any]) -> None:
    """Write `results.json`; NaN, which JSON has not, becomes null.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_results(Path(folder), {"objective": float("nan")})
    ...     json.loads(Path(folder, RESULTS).read_text())
    {'objective': None}
    """
    text = json.dumps(json.loads(json.dumps(results), parse_constant=lambda _: None), indent=2)
    write_atomically(folder / RESULTS, text.encode())
