"""Ensembles and requests for tuning, as the files of configs/ make them."""

import functools

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tests.support import ROOT
from usvlearn import Ensemble, Estimator, Persistence
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.runs.replay import replay
from usvlearn.sweeps.tuning import tune as tuning

TWO_BOATS = ["data.n=2", "data.hours=0.05", "data.mission_minutes=1.5", "data.seed=7", "estimators.rnn.neurons=4"]


def added(member: str) -> list[str]:
    """What adds a member to the default configuration, if it is not there."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        return [] if member in compose("train").estimators else [f"+estimator@estimators.{member}={member}"]


def configured(*overrides: str) -> dict:
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        return OmegaConf.to_container(compose("train", [*TWO_BOATS, *overrides]), resolve=True)


@functools.cache
def short_season() -> dict:
    """Settings of two boats and six minutes; nobody changes them."""
    return configured("data.hours=0.1", "data.mission_minutes=2", "data.sensors.surge_hz=5")


def request(*overrides: str) -> tuning.Request:
    return tuning.request(configured(*overrides), instantiate)


def replayed(fleet, estimator: Estimator) -> list[float]:
    """MAE of each boat, by the main job's own replay and scores."""
    ensemble = Ensemble({"one": estimator, "persistence": Persistence()})
    chunks = list(replay(ensemble, fleet, ensemble.init((len(fleet.boats),))))
    published = [(*chunk.begin, {"predictions": chunk.published["predictions"]}) for chunk in chunks]
    scores = fleet_scores(fleet, published, ensemble.names)
    return [scores[boat]["one"]["mae"] for boat in fleet.boats]


def default_ensemble(dtype: torch.dtype, mass: float = 28.0, **more_rules) -> Ensemble:
    """The ensemble of `train.py`, as it is by default."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"vehicle.mass={mass}"])
    rules = instantiate(cfg.combiners, _convert_="all") | more_rules
    return Ensemble(instantiate(cfg.estimators), rules, cfg.output).to(dtype)
