"""Judge saved runs.

python evaluate.py runs=multirun/DIR     the jobs of a sweep, or any folder of runs: one table, the best first
"""

import json
import sys
from pathlib import Path

import hydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from usvlearn.errors import ConfigError, UsvlearnError
from usvlearn.evaluation.tables import sweep_table

console = Console(markup=False)


def jobs(folder: Path) -> list[tuple[dict[str, str], dict]]:
    """The runs below a folder: what was overridden in each, and its results ({} where it did not finish)."""
    found = []
    for overrides in sorted(folder.glob("**/.hydra/overrides.yaml")):
        results = overrides.parents[1] / "results.json"
        settings = dict(text.partition("=")[::2] for text in OmegaConf.load(overrides))
        found.append(
            (
                settings or {"run": overrides.parents[1].name},
                _read(results),
            )
        )
    if not found:
        raise ConfigError(f"runs: found no run below {str(folder)!r}, expected a folder that train.py has written")
    return found


def _read(results: Path) -> dict:
    try:
        return json.loads(results.read_text())
    except (OSError, ValueError):
        return {}


class SweepTable(Callback):
    """Prints a sweep's table at its end; the exit code is 2 where a job failed."""

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        found = jobs(Path(config.hydra.sweep.dir))
        console.print(sweep_table(found))
        if any("boats" not in results for _, results in found):
            sys.exit(2)


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    try:
        if cfg.runs is None:
            raise ConfigError("runs is not set: set runs=FOLDER, a folder that train.py has written")
        console.print(sweep_table(jobs(Path(cfg.runs))))
    except UsvlearnError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
