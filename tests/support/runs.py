"""Run folders that are made without the command, and what reads them."""

import numpy as np
from hydra.utils import instantiate
from rich.console import Console

from usvlearn import AID, RLS, Ensemble, Persistence, SurgeDynamics
from usvlearn.composition.configuration import ensemble_of
from usvlearn.core import checkpoint
from usvlearn.logs.recordings import align_fleet
from usvlearn.report.build import Tools
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder

SETTINGS = {
    "configuration": {
        "estimators": {"aid": 1, "rls": 2}, "combiners": {}, "data": {}, "align": {"dt": 0.4}, "vehicle": {"mass": 28.0}
    }
}  # fmt: skip

TWO_MEMBERS = [  # settings of the command: two members, some minutes
    "~estimators.rnn", "~estimators.joint", "~estimators.joint_quick", "~estimators.arx", "~estimators.joint_averaged",
    "~combiners.ensemble", "~combiners.weighted", "output=average", "combiners.average.members=[aid,sift_map]",
    "forecasts=null", "data.hours=0.05", "data.mission_minutes=1.5", "data.n=1",
]  # fmt: skip


def model() -> Ensemble:
    return Ensemble({"aid": AID(28.0), "rls": RLS(SurgeDynamics(28.0)), "persistence": Persistence()})


def session(
    folder, fleet, resume=None, configuration=SETTINGS["configuration"], save_every=10, planar=None
) -> RunFolder:
    ensemble = model() if planar is None else planar.surge
    folder = RunFolder(folder, fleet, ensemble, configuration, planar)
    start = folder.begin(ensemble.init((2,)), resume)
    with folder:
        beside = planar, folder.beside
        for chunk in replay(ensemble, fleet, start.state, start.position, 7, save_every, *beside):
            folder.save(chunk)
    return folder


def contents(folder) -> dict[str, np.ndarray]:
    """Every leaf of every checkpoint and every prediction."""
    leaves = {}
    for path in sorted(folder.path.rglob("*.safetensors")):
        for name, leaf in checkpoint.load(path)[0].items():
            leaves[f"{path.relative_to(folder.path)}:{name}"] = leaf
    return leaves | {f"run {k}": array for k, array in enumerate(published(folder, "predictions"))}


def published(folder: RunFolder, name: str) -> list[np.ndarray]:
    """What was published, an array per run."""
    runs: dict[int, list[np.ndarray]] = {}
    for run, _, arrays in folder.published:
        runs.setdefault(run, []).append(arrays[name])
    return [np.concatenate(parts) for parts in runs.values()]


def assert_same(found, expected) -> None:
    found, expected = contents(found), contents(expected)
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def tools(trust=None) -> Tools:
    return Tools(instantiate, ensemble_of, align_fleet, Console(quiet=True), trust)


def forge(folder, change) -> None:
    """Change the settings in all checkpoints of a run; their checksums fit."""
    for path in folder.glob("checkpoints/*/*.safetensors"):
        leaves, facts = checkpoint.load(path)
        change(facts["configuration"])
        checkpoint.save(path, leaves, **{key: value for key, value in facts.items() if key != "schema"})
