"""Tuning one estimator of an ensemble: three methods with the same budget, and the files that they write.

tuning.json       method, command, ranges, default, best; evaluations with MAE per boat, of more than MANY the best
evaluations.npz   every evaluation, with its errors on each run; landscape.png draws them (`tuning.landscape`)
experiment.yaml   the best setting, ready for configs/experiment
results.json      the objective, and the default, the tuned setting and persistence, in the form of a replay
tensorboard       the best settings side by side; for `learn` the curves
"""

from __future__ import annotations

import copy
import json
import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rich.console import Console

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.protocol import check_estimator
from usvlearn.core.samples import Fleet
from usvlearn.display.tensorboard import TensorBoardWriter, folder_name
from usvlearn.display.terminal import Activity, Blocks, show
from usvlearn.engine.lanes import chosen_device
from usvlearn.errors import ConfigError, under
from usvlearn.estimators.baselines.persistence.layer import Persistence
from usvlearn.evaluation.free_simulation import check_halves
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.evaluation.objective import COVERAGE, FREE, ONE_STEP, SKILL, Measure, measure_of
from usvlearn.report.tables import tuning_table
from usvlearn.runs.files import CHECKPOINTS, TENSORBOARD, TUNING, digest, save_results
from usvlearn.sweeps.launchers import set_threads
from usvlearn.sweeps.tuning import WAYS, asked
from usvlearn.sweeps.tuning.batches import (
    NEXT,
    Build,
    Evaluation,
    Hyperparameter,
    Objective,
    hyperparameter,
    hyperparameters,
)
from usvlearn.sweeps.tuning.landscape import explore
from usvlearn.sweeps.tuning.methods import Fitted, descend, grid, product
from usvlearn.sweeps.tuning.search import search


class Request(NamedTuple):
    """A checked request for tuning."""

    way: str  # one of WAYS
    member: str
    parameters: list[Hyperparameter]
    values: dict[str, list[float]] | None  # of an explicit grid
    evaluations: int  # the budget; for an explicit grid the number of its points
    options: Mapping[str, Any]  # `tuning` of the configuration
    node: Mapping[str, Any]  # the member's configuration
    build: Build
    measure: Measure = NEXT  # which error is minimised

    @property
    def ranges(self) -> dict[str, list[float]]:
        return {each.path: [each.low, each.high] for each in self.parameters}


def request(configuration: Mapping[str, Any], instantiate: Callable[[Any], Any]) -> Request:
    """The tuning that a configuration asks for, checked."""
    if (way := asked(configuration)) is None:
        raise ConfigError(f"experiment: found no tuning, expected one of {', '.join(WAYS)}: add {WAYS[0]}=MEMBER")
    given, options, members = configuration[way], configuration["tuning"], configuration["estimators"]
    options = {**options, "device": chosen_device(options["device"])}
    for key, least in {"evaluations": 1, "rounds": 1, "trials": 1, "seed": 0}.items():
        if isinstance(options[key], bool) or not isinstance(options[key], int) or options[key] < least:
            raise ConfigError(f"tuning.{key}: found {options[key]!r}, expected a whole number, {least} or more")
    if options["rounds"] > options["evaluations"]:
        raise ConfigError(f"tuning.rounds: found {options['rounds']}, expected at most tuning.evaluations")
    explicit = way == "grid" and isinstance(given, Mapping)
    names: list[Any] = list(dict.fromkeys(str(key).partition(".")[0] for key in given)) if explicit else [given]
    if len(names) != 1:
        raise ConfigError(f"grid: found {', '.join(names) or 'no values'}, expected values of one member, MEMBER.PATH")
    (member,) = names
    if not isinstance(member, str) or member not in members:
        raise ConfigError(f"{way}: found {member!r}, expected one of the members {', '.join(members)}")

    build = builder(members, member, instantiate)
    estimator = check_estimator(f"{way}={member}", build({}))
    if explicit:
        values = {str(key).partition(".")[2]: _listed(key, each) for key, each in given.items()}
        parameters = [
            hyperparameter(estimator, path, min(each), max(each), f"{member}.{path}") for path, each in values.items()
        ]
        options = {**options, "evaluations": math.prod(map(len, values.values()))}
    else:
        if not isinstance(options["ranges"], Mapping):
            raise ConfigError(f"tuning.ranges: found {options['ranges']!r}, expected {{MEMBER: {{PATH: [LOW, HIGH]}}}}")
        values, ranges = None, options["ranges"].get(member)
        if not ranges:
            raise ConfigError(
                f"{way}={member}: has no range to tune in: add '+tuning.ranges.{member}={{PATH: [LOW, HIGH]}}'; it has "
                f"{', '.join(hyperparameters(estimator)) or 'no hyperparameter that could be tuned'}"
            )
        parameters = []
        for path, each in ranges.items():
            low, high = _bounds(key := f"tuning.ranges.{member}.{path}", each)
            parameters.append(hyperparameter(estimator, path, low, high, key))
    measure = measure_of(configuration.get("objective"), member)
    if measure.estimator != member:
        raise ConfigError(f"objective: found {measure} with {way}={member}, expected {member} or {member}.KIND")
    if measure.kind in (SKILL, COVERAGE):
        raise ConfigError(f"objective: found {measure} with {way}={member}, expected one of its errors: {member}, "
                          f"{member}.forecast.SECONDS or {member}.free")  # fmt: skip
    if way == "learn" and measure.kind != ONE_STEP:
        raise ConfigError(
            f"objective: found {measure} with learn={member}, which minimises the error one step ahead: use grid or "
            "search"
        )
    return Request(way, member, parameters, values, options["evaluations"], options, members[member], build, measure)


def builder(members: Mapping[str, Any], member: str, instantiate: Callable[[Any], Any]) -> Build:
    """Makes a member of a configuration with changed settings."""

    def build(values: Mapping[str, Any]) -> Any:
        with under(f"estimators.{member}", members[member]):
            return instantiate(_changed(members[member], values))

    return build


def _changed(node: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A constructor's configuration with new values at dotted paths; lists stay lists."""
    changed = {**copy.deepcopy(node), "_convert_": "all"}
    for path, value in values.items():
        *parents, last = path.split(".")
        place = changed
        for parent in parents:
            place = place[parent]
        place[last] = value
    return changed


def _bounds(key: str, given: Any) -> Sequence[float]:
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
        raise ConfigError(f"{key}: found {given!r}, expected a range [LOW, HIGH]")
    return given


def _listed(key: str, given: Any) -> list[float]:
    values = given if isinstance(given, list) else [given]
    if not values:
        raise ConfigError(f"grid: found no values of {key}, expected a list of one or more")
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        raise ConfigError(f"grid: found {given!r} for {key}, expected numbers")
    return [float(x) for x in dict.fromkeys(values)]


def check_folder(folder: Path, way: str, member: str) -> None:
    """Raise a ConfigError if a folder already holds something else."""
    if (folder / CHECKPOINTS).exists():
        raise ConfigError(f"{folder}: already holds the checkpoints of a run: choose another hydra.run.dir")
    try:
        old = json.loads((folder / TUNING).read_text())
    except (OSError, ValueError):
        return
    if way != "search" or (old.get("way"), old.get("member")) != (way, member):  # only a search continues
        raise ConfigError(f"{folder}: already holds {old.get('way')}={old.get('member')}: choose another hydra.run.dir")


def tune(
    configuration: Mapping[str, Any],
    folder: Path,
    instantiate: Callable[[Any], Any],
    align: Callable[..., Fleet],
    overrides: Sequence[str] = (),
    console: Console | None = None,
) -> float:
    """Tune as a configuration asks, and write the results; returns the best MAE, m/s; infinite if all diverge."""
    set_threads(configuration["threads"])
    asked_for, console = request(configuration, instantiate), console or Console(quiet=True)
    if (resume := configuration.get("resume")) is not None:
        raise ConfigError(f"resume: found {resume!r} with {asked_for.way}, which cannot resume: leave it out")
    check_folder(folder, asked_for.way, asked_for.member)
    with Activity(console), under("data", configuration["data"]):
        fleet = align(instantiate(configuration["data"]), **configuration["align"])
    if asked_for.measure.kind == FREE:
        check_halves(fleet)
    began = time.perf_counter()
    with Activity(console) as activity:
        activity.begin(f"{asked_for.way}={asked_for.member}", total=asked_for.evaluations)
        tried, used, curve = run(asked_for, fleet, folder, activity.advance)
    (persistence,) = Objective(lambda _: Persistence(), fleet, measure=asked_for.measure)([{}])
    facts = {
        "member": asked_for.member,
        "way": asked_for.way,
        "measure": str(asked_for.measure),
        "device": asked_for.options["device"],
        "command": shlex.join(["python", "train.py", *overrides]),
        "evaluations": used,
        "ranges": asked_for.ranges,
        "seconds": time.perf_counter() - began,
    }
    facts["landscape"] = explore(folder, asked_for.parameters, tried)
    content = record(facts, fleet.boats, tried, persistence)
    write(folder, content, curve)
    console.print(report(content))
    show(content["landscape"]["told"], to=console)
    show(f"The best setting, for configs/experiment: {folder / EXPERIMENT}", to=console)
    return math.inf if content["best"]["mae"] is None else content["best"]["mae"]


def run(
    request: Request, fleet: Fleet, folder: Path, advance: Callable[[float], None] = lambda evaluations: None
) -> Fitted:
    """Run the requested search; its evaluations, the default first."""
    options, parameters = request.options, request.parameters
    objective = Objective(request.build, fleet, advance, measure=request.measure, device=options["device"])
    if request.values is not None:
        default = {each.path: each.default for each in parameters}
        settings = [setting for setting in product(request.values) if setting != default]
        return Fitted(objective([default, *settings]), len(settings))
    if request.way == "grid":
        return grid(objective, parameters, request.evaluations, options["rounds"])
    if request.way == "learn":
        return descend(objective, parameters, request.evaluations, options["start"])
    samples = [digest(run, element) for run in fleet.runs for element in range(len(fleet.boats))]
    facts = {"member": request.member, "configuration": request.node, "ranges": request.ranges, "samples": samples}
    return search(objective, parameters, request.evaluations, folder, facts, options["trials"], options["seed"])


EXPERIMENT = "experiment.yaml"
SHOWN, MANY, BEST = 20, 1000, 200  # settings in the terminal; of more than MANY, in files; on the HPARAMS page


def gain(mae: float, base: float) -> float | None:
    """The reduction of an error, in percent; None if it is unknown."""
    return 100 * (1 - mae / base) if base > 0 and math.isfinite(base) and math.isfinite(mae) else None


def record(
    facts: Mapping[str, Any], boats: Sequence[str], tried: Sequence[Evaluation], persistence: Evaluation
) -> dict[str, Any]:
    """The content of `tuning.json`, the default first in `tried`; an error that is not finite is None."""
    default = tried[0]

    def row(each: Evaluation) -> dict[str, Any]:
        maes = dict(zip(boats, map(_finite, each.maes), strict=True))
        return {"setting": dict(each.setting), "mae": _finite(each.mae), "boats": maes,
                "gain": gain(each.mae, default.mae)}  # fmt: skip

    best = min(tried, key=lambda each: each.mae)
    listed = tried
    if len(tried) > MANY:
        unlike = {label(each.setting): each for each in sorted(tried[1:], key=lambda each: each.mae, reverse=True)}
        listed = [default, *sorted(unlike.values(), key=lambda each: each.mae)[:BEST]]
    return {
        **facts,
        "default": row(default),
        "best": row(best),
        PERSISTENCE: {key: value for key, value in row(persistence).items() if key in ("mae", "boats")},
        "diverged": sum(not math.isfinite(each.mae) for each in tried),
        "evaluated": [row(each) for each in listed],
    }


def write(folder: Path, record: Mapping[str, Any], curve: Sequence[Mapping[str, float]] = ()) -> None:
    """Write all files, `results.json` last."""
    write_atomically(folder / TUNING, json.dumps(record, indent=2, allow_nan=False).encode())
    write_atomically(folder / EXPERIMENT, experiment(record).encode())
    with TensorBoardWriter(folder / TENSORBOARD) as board:
        for k, numbers in enumerate(curve):
            board.scalars({f"learn/{name}": x for name, x in numbers.items()}, k)
        best = [each for each in ranked(record)[:BEST] if each["mae"] is not None]
        tag = f"MAE of {record['member']} (m/s)"
        if best:
            paths = dict.fromkeys(path for each in best for path in each["setting"])
            values = {path: [each["setting"][path] for each in best if path in each["setting"]] for path in paths}
            board.columns(values, {tag: tag})
        for each in best:
            board.session(each["setting"], run := folder_name(label(each["setting"])))
            board.scalars({tag: each["mae"]}, 0, run)
    boats = {}
    for boat, base in record[PERSISTENCE]["boats"].items():
        maes = {"default": record["default"]["boats"][boat], "tuned": record["best"]["boats"][boat], PERSISTENCE: base}
        boats[boat] = {
            name: {"mae": mae, "skill": None if mae is None or not base else 1 - mae / base}
            for name, mae in maes.items()
        }
    best = record["best"]
    results = {"boats": boats, "seconds": record["seconds"], "objective": best["mae"], "best": label(best["setting"])}
    save_results(folder, results | {"measure": record.get("measure", record["member"])})


def ranked(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All evaluations, the best first."""
    return sorted(record["evaluated"], key=lambda each: math.inf if each["mae"] is None else each["mae"])


def label(setting: Mapping[str, Any]) -> str:
    """A setting as a short text that can name a run."""
    return " ".join(f"{path.rpartition('.')[2]}={_short(value)}" for path, value in setting.items())


def report(record: Mapping[str, Any]) -> Blocks:
    """For the terminal: the best settings, the default, persistence."""
    rows = [(f"{k}", label(each["setting"]), each) for k, each in enumerate(ranked(record)[:SHOWN], 1)]
    rows.append(("default", label(record["default"]["setting"]), record["default"]))
    rows.append((PERSISTENCE, "", record[PERSISTENCE]))
    diverged = f", {record['diverged']} diverged" if record["diverged"] else ""
    title = f"{record['way']}={record['member']}: {record['evaluations']} evaluations{diverged}"
    return tuning_table(title, rows)


def experiment(record: Mapping[str, Any]) -> str:
    """The best setting as a file of configs/experiment."""
    default, best, base = record["default"]["mae"], record["best"], record[PERSISTENCE]["mae"]
    change = "" if best["gain"] is None else f", {best['gain']:.1f} % less"
    head = [
        "# @package _global_",
        f"# Found by: {record['command']}",
        f"# MAE {_error(best['mae'])} m/s, mean over {len(best['boats'])} boats, in {record['evaluations']} evaluations"
        f"; the default has {_error(default)}{change}; persistence {_error(base)}.",
    ]
    tree: dict[str, Any] = {}
    for path, value in best["setting"].items():
        *parents, last = path.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = value
    return "\n".join([*head, yaml.safe_dump({"estimators": {record["member"]: tree}}, sort_keys=False)])


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else Path(str(value)).stem


def _error(mae: float | None) -> str:
    return "none (diverged)" if mae is None else f"{mae:.5f}"
