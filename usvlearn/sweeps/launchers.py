"""The launchers that start the jobs of a sweep, and the settings of their workers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from shutil import which

from usvlearn.errors import ConfigError, MissingExtraError, check_positive, did_you_mean

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
SLURM = ("srun", "sbatch")
LAUNCHERS = {  # name -> its plugin, and the extra that installs it
    "basic": None,
    "joblib": ("hydra_joblib_launcher", "sweep"),
    **dict.fromkeys(["slurm", "submitit_slurm", "submitit_local"], ("hydra_submitit_launcher", "slurm")),
}


def check_launcher(arguments: Sequence[str]) -> None:
    """Raise unless the launcher that a command line names is known, installed, and can start jobs here."""
    for argument in arguments:
        key, _, name = argument.partition("=")
        if key.lstrip("+") != "hydra/launcher" or name == "basic":
            continue
        plugin, extra = LAUNCHERS.get(name) or (f"hydra_{name}_launcher", None)
        if not (find_spec("hydra_plugins") and find_spec(f"hydra_plugins.{plugin}")):
            if extra is None:
                hint = did_you_mean(name, LAUNCHERS)
                raise ConfigError(f"hydra/launcher: found {name!r}, expected one of {', '.join(LAUNCHERS)}{hint}")
            raise MissingExtraError(plugin.replace("_", "-"), extra, argument)
        if missing := [tool for tool in SLURM if which(tool) is None] if name.endswith("slurm") else []:
            what = " and ".join(missing)
            raise ConfigError(f"{argument}: found no {what}, expected a Slurm cluster: start it there, or take joblib")


def prepare_workers(root: Path) -> None:
    """Set one thread for each process that a launcher starts, and let them import the scripts in `root`."""
    os.environ |= dict.fromkeys(THREADS, "1")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))


def set_threads(count: float, seed: int = 0) -> None:
    """Set the number of threads of torch, and the seed of the random weights of modules that others have written."""
    import torch

    torch.set_num_threads(max(1, int(check_positive("threads", count))))
    torch.manual_seed(seed)
