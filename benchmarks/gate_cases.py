"""The cases of the gates: what must not change unless a commit says so. Each is a function that makes a dict of parts.

A name is "gate/case". A case that is None lacks what it needs, such as recorded logs. Random numbers are seeded; no
search has a time limit, so that a verdict does not depend on the load of the machine.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import accuracy
import numpy as np
import torch
from families import initial_networks, random_networks, signed_networks
from speed import as_numbers

from certify.analysis.assess import assess
from certify.networks.shallow import Network, ShallowWeights
from certify.networks.vector import RELU, VectorNetwork
from certify.proofs import certificate, vector_certificate
from certify.search import box
from tests.support import ESTIMATORS
from tests.support.kernel_cases import LONG, mission
from tests.support.networks import vector_network
from tests.support.shapes import SHAPES, Shape, certainties, score
from tests.support.traps import TRAPS
from tests.support.vector_networks import draw_scaling
from tests.support.voyages import voyage
from usvlearn import Ensemble, Estimator, Inputs, Online, PlanarSample, Sample, forecast, rollout
from usvlearn.cli.export import export
from usvlearn.cli.train import work
from usvlearn.composition.configuration import planar_of
from usvlearn.core import checkpoint
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.rollouts import chunked_rollout, simulate
from usvlearn.errors import UsvlearnError
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.read_boats import read_boats
from usvlearn.simulate.planar_fleet import planar_fleet

Case = dict[str, Any]
TYPES = {"float64": torch.float64, "float32": torch.float32}
STEPS, EAGER = 300, 20  # of a replay; of one through torch
PLAN = 75  # steps of a forecast
UNLIMITED = 1e5  # s of a search, which ends by its count of boxes
ONE, VECTOR, GROUP = 350, 150, 50  # networks of one state, of a vector state, and in a case
PASSING = ("seconds", "versions", "sha256", "usvlearn", "version")  # keys of values that name a moment or a version
LOGS = ("blueboat", "vtec", "dalian", "pearl")


def cases(shared: Path) -> dict[str, Callable[[], Case | None]]:
    """All cases, in the order in which they are compared."""
    torch.set_num_threads(1)
    single, vector = range(ONE // GROUP), range(VECTOR // GROUP)
    return {
        **{f"steps/{name}": partial(steps_of, make, ()) for name, make in ESTIMATORS.items()},
        **{f"steps/batch_{name}": partial(steps_of, make, (4,)) for name, make in LONG.items()},
        "steps/default_ensemble": partial(steps_of, partial(accuracy.ensemble, ()), ()),
        "steps/default_tracks": track_steps,
        "runs/default": partial(run_of, ("data.hours=0.3",)),
        **{f"runs/{name}": partial(recorded_run, shared / "data", name) for name in LOGS},
        **{f"certificates/one_state_{k}": partial(verdicts, k) for k in single},
        **{f"certificates/vector_{k}": partial(vector_verdicts, k) for k in vector},
        **{f"inspect/{name}": partial(inspected, shape) for name, shape in (SHAPES | TRAPS).items()},
        "inspect/strangers": partial(strangers, shared / "strangers" / "inputs"),
        "exports/default": exports,
    }


# Steps


@torch.no_grad()
def steps_of(make: Callable[[], Estimator], batch: tuple[int, ...]) -> Case:
    """States and predictions of one estimator in each way to make its steps."""
    case: Case = {}
    for name, dtype in TYPES.items():
        estimator = copy.deepcopy(make()).to(dtype)  # a cached ensemble stays as it is
        samples, start = mission(STEPS, *batch, dtype=dtype), estimator.init(batch)
        recorded = [leaf for leaf, _ in named_leaves(start)]
        state, surge, states = rollout(estimator, start, samples, recorded, backend="kernel")
        case[f"{name} replay by step"] = {"surge": surge, "state": states}
        _, surge, states = simulate(estimator, state, samples, recorded, backend="kernel")
        case[f"{name} open loop by step"] = {"surge": surge, "state": states}
        case |= called(f"{name} single steps", Online(estimator, batch), one_by_one(samples, batch))
        if isinstance(estimator, Ensemble) and estimator.forecasts:
            plan = tree_map(lambda x: x.nan_to_num(0.0).clamp(-1, 1), mission(PLAN, *batch, dtype=dtype, faults=False))
            case[f"{name} forecast by step"] = forecast(estimator, state, plan.inputs)._asdict()
    estimator, samples = copy.deepcopy(make()).to(torch.float64), mission(EAGER, *batch)
    start = estimator.init(batch)
    recorded = [leaf for leaf, _ in named_leaves(start)]
    _, surge, states = rollout(estimator, start, samples, recorded, backend="torch")
    return case | {"float64 torch by step": {"surge": surge, "state": states}}


def one_by_one(samples: Sample, batch: tuple[int, ...]) -> list[Sample]:
    if not batch:
        return as_numbers(samples)
    return [tree_map(lambda x, k=k: x[k].numpy(), samples) for k in range(len(samples.surge))]


def called(name: str, online: Online, calls: Sequence[Any]) -> Case:
    """What `Online` predicts, and the state that it ends with."""
    surge = np.array([online.step(each) for each in calls])
    return {f"{name} by step": surge, f"{name}, last state": dict(named_leaves(online.state))}


@torch.no_grad()
def track_steps() -> Case:
    """The default ensemble with sway, yaw rate and tracks, on a simulated boat that turns and drifts."""
    run = align_fleet(planar_fleet(n=2, hours=0.08, mission_minutes=2.4, seed=3)).runs[0]
    part: PlanarSample = tree_map(lambda x: x[:STEPS], run.planar)
    case: Case = {}
    for name, dtype in TYPES.items():
        configured = accuracy.configuration(())
        planar, _ = planar_of(configured, accuracy.ensemble(()))
        planar = copy.deepcopy(planar).to(dtype)
        start = planar.init(part.sample.surge.shape[1:])
        recorded = [leaf for leaf, _ in named_leaves(start)]
        [(state, states)] = chunked_rollout(planar, start, [part], recorded)
        case[f"{name} replay by step"] = states
        online = Online(planar)
        alone = [tree_map(lambda x, k=k: x[k, 0].item(), part) for k in range(len(part.sample.surge))]
        case |= called(f"{name} single steps", online, alone)
        left = np.linspace(-0.5, 1.0, PLAN)
        pair = np.stack([left, left[::-1]], -1)
        case[f"{name} track by step"] = online.forecast(pair)._asdict()
        case[f"{name} forecast by step"] = online.forecast(pair, headings=0.3)._asdict()
        wide = torch.from_numpy(np.repeat(left[:, None], 2, 1)).to(dtype)
        plan = Inputs(wide, wide.flip(0), None, None, torch.full_like(wide, 0.4))
        case[f"{name} tracks of a batch by step"] = forecast(planar, state, plan)._asdict()
    return case


# Runs and exports


@cache
def finished(overrides: tuple[str, ...]) -> tuple[tempfile.TemporaryDirectory, Path]:
    """The folder of a run, which is removed when the process ends."""
    temporary = tempfile.TemporaryDirectory(prefix="usvlearn-gate-")
    folder = Path(temporary.name) / "run"
    with quiet():
        work(accuracy.configuration(overrides), folder, overrides, quiet=True)
    return temporary, folder


def run_of(overrides: tuple[str, ...], logs: Path | None = None) -> Case:
    """`results.json`, the predictions and the checkpoints of a run; texts do not tell where the logs are."""
    _, folder = finished(overrides)
    results = without_place((folder / "results.json").read_text(), folder, *([] if logs is None else [logs]))
    case: Case = {"results": lasting(json.loads(results))}
    for path in sorted(folder.glob("predictions/*.npz")):
        with np.load(path) as archive:
            stepped = {name: archive[name] for name in archive.files if archive[name].dtype.kind == "f"}
        case[f"predictions {path.stem} by step"] = stepped
    for path in sorted(folder.rglob("*.safetensors")):
        arrays = checkpoint.load(path)[0]  # safetensors lists them in another order in each process
        case[f"checkpoint {path.relative_to(folder)}"] = dict(sorted(arrays.items()))
    return case


def recorded_run(logs: Path, name: str) -> Case | None:
    if not (logs / name).is_dir():
        return None
    return run_of((f"data={name}", f"data.path={logs / name}"), logs)


def exports() -> Case:
    """The text of the C, JSON and CasADi files of the default run."""
    _, folder = finished(("data.hours=0.3",))
    with tempfile.TemporaryDirectory() as out, quiet():
        written = export(read_boats(folder), ["c", "json", "casadi"], folder, Path(out))
        text = {path.name: path.read_text() for path in sorted(written)}
    return {
        name: lasting(json.loads(each)) if name.endswith(".json") else without_place(each, folder)
        for name, each in text.items()
    }


def without_place(text: str, *folders: Path) -> str:
    """A text without the names of temporary folders."""
    for folder in folders:
        text = text.replace(str(folder), "FOLDER")
    return text


def lasting(tree: Any) -> Any:
    """JSON without what differs between two runs or two versions."""
    if isinstance(tree, Mapping):
        return {key: lasting(each) for key, each in tree.items() if key not in PASSING}
    return [lasting(each) for each in tree] if isinstance(tree, list) else tree


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    with (
        warnings.catch_warnings(action="ignore"),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        yield


# Certificates


def verdicts(group: int) -> Case:
    """What is found of networks of one state, and the certificates of all conditions that hold."""
    rng, n = np.random.default_rng([48, group]), (4, 6, 8, 10, 12, 16, 20)[group % 7]
    third = GROUP // 3
    drawn = [*random_networks(GROUP - 2 * third, n, rng), *initial_networks(third, n, rng)]
    return {f"network {k}": assessed(w) for k, w in enumerate([*drawn, *signed_networks(third, n, n // 4, rng)])}


def assessed(weights: ShallowWeights) -> Case:
    inside = box.operating_box(weights.W2.shape[1])
    row, _ = assess(Network("network", weights), box=inside, seconds=UNLIMITED)
    certificates = {name: certificate.make(weights, name) for name in certificate.CLOSED_FORMS}
    certificates["interval"] = certificate.make(weights, "interval", box=inside)
    if (rate := row["box"]["proved_rate"]) is not None:
        trees = {name: row["box"][name] for name in ("tree", "invariance_tree")}
        certificates["box"] = certificate.make(weights, "box", rate, inside, **trees)
    return {"verdicts": lasting(row), "certificates": lasting(certificates)}


def vector_verdicts(group: int) -> Case:
    """Likewise of a vector state; the scaling is searched for in every fifth network, and drawn in the others."""
    case, rng = {}, np.random.default_rng([49, group])
    for k in range(GROUP):
        q, n, last = ((2, 3, 0), (2, 4, 2), (3, 3, 0))[k % 3]
        network = VectorNetwork("network", vector_network(rng, q, 1, n, last), RELU)
        if k % 5 == 0:
            row, certificates = assess(network, seconds=UNLIMITED, steps=True)
            case[f"network {k}"] = {"verdicts": lasting(row), "certificates": lasting(certificates)}
            continue
        T, norm = draw_scaling(rng, q), ("inf", "one")[k % 2]
        exact = vector_certificate.make(network, "exact", norm=norm, scaling=T)
        lemma = vector_certificate.make(network, "gershgorin")
        case[f"network {k}"] = {"exact": lasting(exact), "gershgorin": lasting(lemma)}
    return case


# Inspection


def inspected(shape: Shape) -> Case:
    """How right a proposal is, and the file that it writes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "logs"  # which may give the boat its name
        folder.mkdir()
        given = shape.write(folder, voyage(0, **shape.options))
        with warnings.catch_warnings(action="ignore"):
            result = inspect_logs([str(given)])
        scored = score(result.proposal.channels, certainties(result.decisions), shape.truth)
        counts = {name: len(each) for name, each in scored._asdict().items()}
        return {"counts": counts, "score": scored, "proposal": without_place(result.text, folder)}


def strangers(source: Path) -> Case | None:
    """What is proposed for the small logs of strangers, or the sentence of the refusal."""
    if not (source / "make.py").is_file():
        return None
    case: Case = {}
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary) / "logs"
        subprocess.run([sys.executable, "-B", "-W", "ignore", source / "make.py", place], check=True)
        for path in sorted(place.iterdir()):
            try:
                with warnings.catch_warnings(action="ignore"):
                    result = inspect_logs([str(path)])
                said = {"text": result.text, "decisions": [" ".join(map(str, each)) for each in result.decisions]}
            except UsvlearnError as error:
                said = {"refused": str(error)}
            except Exception as error:  # a defect, which is recorded, too
                said = {"failed": f"{type(error).__name__}: {error}"}
            case[path.name] = {
                name: without_place(each, place) if isinstance(each, str) else [without_place(x, place) for x in each]
                for name, each in said.items()
            }
    return case
