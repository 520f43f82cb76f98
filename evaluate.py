"""Judge saved runs, or make a whole study.

python evaluate.py runs=outputs/RUN                 a report: errors, free runs, certificates, parameters
python evaluate.py runs=outputs/RUN data=blueboat data.path=LOGS      on other logs of the same boats
python evaluate.py runs=multirun/DIR                the jobs of a sweep: one table, the best first
python evaluate.py experiment=paper                 the paper's study from nothing, on a simulated fleet
"""

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import hydra
import torch
from hydra import compose
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

from train import train
from usvlearn import Ensemble, __version__
from usvlearn.errors import ConfigError, bad_input
from usvlearn.evaluation.judge import best_start, facts, judge, simulations
from usvlearn.evaluation.report import write_report
from usvlearn.evaluation.season import Season
from usvlearn.evaluation.section import Section
from usvlearn.evaluation.sections.tuning import tuning_section
from usvlearn.learning.saved import configuration, read_seasons, results, run_folders
from usvlearn.learning.study import Study
from usvlearn.logs.fleet import align_fleet
from usvlearn.simulate.truth import truth_of

console = Console(markup=False)
warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def seasons_of(folders: Sequence[Path], data: DictConfig | None = None) -> tuple[Ensemble, list[Season], dict]:
    """The ensemble of some runs, what they left of each boat, and the truth where all is simulated without a fault."""
    settings = [OmegaConf.create(configuration(folder)) for folder in folders]
    last, sources = settings[-1], [each.data for each in settings] if data is None else [data]
    ensemble = Ensemble(instantiate(last.estimators), instantiate(last.combiners, _convert_="all"), last.output)
    with console.status("reading and aligning"):
        fleets = [align_fleet(instantiate(each), **last.align) for each in sources]
    return ensemble, read_seasons(folders, ensemble, fleets), truth_of(sources, last.vehicle.mass)


def evaluate(folders: Sequence[Path], report: Path, data: DictConfig | None = None, *, more: Sequence[Section] = (),
             commands: Sequence[str] = (), title: str = "What was learned") -> Path:  # fmt: skip
    """Write the report of some runs, on their own logs or on `data`; returns its page."""
    ensemble, seasons, truth = seasons_of(folders, data)
    with Progress(console=console) as progress:
        bar = progress.add_task("simulating", total=simulations(seasons))
        sections, errors = judge(ensemble, seasons, truth, lambda steps: progress.update(bar, advance=steps))
    return write_report(report, title, facts(seasons, folders), [*more, *sections], commands, errors)


def study(cfg: DictConfig) -> Path:
    """Tune on one season, learn the next one, and judge it; goes on where it stopped."""
    folder, plan = Path(cfg.folder), {**OmegaConf.to_container(cfg.study), "version": __version__}
    made = Study(
        folder, plan,
        train=lambda overrides, where: train(compose("train", list(overrides)), where),
        tune=lambda overrides, where: None,
        choose=lambda where: best_start(*seasons_of([where])[:2]), say=console.print,
    )  # fmt: skip
    before, after = made.seasons(found := made.tune())
    gained = tuning_section(found, results(after)["boats"], results(before)["boats"])
    return evaluate([after], folder / "report", more=[gained], commands=made.commands, title="The paper's study")


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(1)
    try:
        if cfg.study is None and cfg.runs is None:
            raise ConfigError("runs is not set: set runs=FOLDER, a folder that train.py has written")
        if cfg.study is not None:
            page = study(cfg)
        else:
            page = evaluate(run_folders(cfg.runs), Path(cfg.report or Path(cfg.runs) / "report"), cfg.get("data"))
        console.print(f"report: {page}")
    except Exception as error:
        if (cause := bad_input(error, hydra.errors.InstantiationException)) is None:
            raise
        print(f"error: {cause}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
