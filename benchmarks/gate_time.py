"""The time of a step against that of a recorded source, in one process: the recorded package gets another name."""

from __future__ import annotations

import importlib
import re
import statistics
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from pages import micro
from speed import Work, as_numbers, called, in_turn, samples

RENAMED = {name: f"{name}_recorded" for name in ("usvlearn", "certify")}
# in an import, and not in the name of the cache's folder
IMPORTED = re.compile(rf"\b({'|'.join(RENAMED)})(?=\.[\w{{]|\s+import\b|\s*$)", re.MULTILINE)
STREAMED, CALLED, ROUNDS = 20_000, 3_000, 15


def renamed(source: Path, into: Path) -> Path:
    """A copy of the recorded packages and their configuration, in which they have their other names."""
    for name in (*RENAMED, "configs"):
        for path in (source / name).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                copy = into / RENAMED.get(name, name) / path.relative_to(source / name)
                copy.parent.mkdir(parents=True, exist_ok=True)
                content = path.read_bytes()
                if path.suffix in (".py", ".yaml"):
                    content = IMPORTED.sub(lambda match: RENAMED[match[1]], content.decode()).encode()
                copy.write_bytes(content)
    return into


def works(package: ModuleType, configs: Path) -> dict[str, Work]:
    """Steps of the default ensemble of a package: streamed through compiled code, and called one by one."""
    with initialize_config_dir(str(configs), version_base="1.3"):
        configuration = importlib.import_module(f"{package.__name__}.composition.configuration")
        ensemble = configuration.ensemble_of(compose("train"))
    run, online = of_package(package, samples(STREAMED)), package.Online(ensemble)
    calls = [of_package(package, each) for each in as_numbers(samples(CALLED))]
    state = ensemble.init()
    return {
        "streamed": partial(package.rollout, ensemble, state, run, backend="kernel"),
        "called": partial(called, online.step, calls),
    }


def of_package(package: ModuleType, sample: Any) -> Any:
    return package.Sample(package.Inputs(*sample.inputs), *sample[1:])


def time_ratios(source: Path) -> list[str]:
    """The time of a step over that of the recorded source: the median, and the middle half of the rounds."""
    import usvlearn

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        sys.path.insert(0, str(renamed(source, Path(folder))))
        recorded = importlib.import_module(RENAMED["usvlearn"])
        configs = Path(__file__).resolve().parents[1] / "configs"
        pairs = {"now": works(usvlearn, configs), "recorded": works(recorded, Path(folder) / "configs")}
        each = {(way, who): work for way in ("streamed", "called") for who, own in pairs.items() for work in [own[way]]}
        spent = in_turn(each, ROUNDS)
        sys.path.remove(folder)
    return [line(way, spent[way, "now"], spent[way, "recorded"]) for way in ("streamed", "called")]


def line(way: str, now: Sequence[float], recorded: Sequence[float]) -> str:
    ratios = [a / b for a, b in zip(now, recorded, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive")
    took = micro(statistics.median(now) / {"streamed": STREAMED, "called": CALLED}[way])
    return f"a {way} step takes {took} µs, {middle:.2f} [{low:.2f}, {high:.2f}] times the recorded one"
