"""A simulated boat as messages, and sessions of a node for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import usvlearn
from tests.support import commands
from usvlearn import ARX, Ensemble, ForecastSettings, JointEKF, Online, Persistence, Planar
from usvlearn.live.health import COMPILING, Health
from usvlearn.live.session import Session
from usvlearn.live.start import Middleware, Options
from usvlearn.logs.channels.channel import DEGREES, REQUIRED, VELOCITIES, Recording
from usvlearn.logs.setup import Setup, setups_of
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.planar_fleet import planar_fleet

PLAIN = Middleware("test", "usvlearn.logs.formats.moos.alog.Alog", {name: {"name": name.upper()} for name in REQUIRED})

TURNING = PLAIN._replace(
    channels={**PLAIN.channels, "yaw_rate": {"name": "YAW_RATE"}},
    auxiliary={name: {"name": name.upper()} for name in (*VELOCITIES, *DEGREES)},
)


@cache
def boat(hours: float = 0.1, seed: int = 0) -> Recording:
    """A simulated boat."""
    return fleet(n=1, hours=hours, seed=seed)[0]


def messages(recording: Recording, start: float = 1.7e9) -> Iterator[tuple[str, float, float]]:
    """Its messages as they came: channel, stamp in s, value in SI units."""
    rows = [
        (place, name, start + time, value)
        for name, channel in recording.channels.items()
        for time, value, place in zip(*(x.tolist() for x in channel[:3]), strict=True)
    ]
    yield from (row[1:] for row in sorted(rows, key=lambda row: row[0]))


def sail(node: Any, sent: Iterable[tuple[str, float, float]], shift: float = 0.0) -> list:
    """Push messages to a node or a session; returns the steps that they complete."""
    return [step for part, stamp, value in sent for step in node.push(part, stamp + shift, value)]


@cache
def learned_set(folder: Path) -> Path:
    """A checkpoint of the default ensemble that has learned from some minutes."""
    return usvlearn.learn(usvlearn.read(data="simulated", hours=0.05)).save(folder / "start.safetensors")


@cache
def turning(hours: float = 0.1) -> Recording:
    """A simulated boat with compass, gyro and GPS."""
    return planar_fleet(hours=hours, seed=7)[0]


def planar() -> Planar:
    """A small one, that has learned nothing."""
    members = {"joint": JointEKF(2.74), "arx": ARX(), "persistence": Persistence()}
    return Planar(Ensemble(members, forecasts=ForecastSettings()), surge_max=2.74)


def planar_setup(recording: Recording) -> Setup:
    return setups_of({"align": {"dt": 0.4}}, [recording])[recording.boat]


def planar_set(folder: Path, reader: str | None = PLAIN.reader) -> Path:
    """A checkpoint of `planar`, as a run keeps it, and beside it one of its ensemble; returns the run's folder."""
    model, setup = planar(), planar_setup(turning()).json()
    setup["reader"] = reader
    for name in setup["channels"]:
        setup["channels"][name]["name"] = name.upper()
    Online(model.surge).save(folder / "checkpoints" / "planar" / "0001_00000001.safetensors", setup=setup)
    Online(model).save(folder / "planar" / "checkpoints" / "planar" / "0001_00000001.safetensors", setup=setup)
    return folder


def ready(folder: Path, start: Path | None, middleware: Middleware = PLAIN, **options) -> Session:
    """A session that listens."""
    session = Session(Options(folder, start, **{"refit": False, **options}), middleware)
    session.start()
    assert session.wait(300)
    return session


def replayed(records: Path, number: int = 1) -> np.ndarray:
    """The predictions of a record that train.py replays as its configuration says, `(steps, members and rules)`."""
    name = f"record_{number:04d}"
    commands.ran(f"data={name}.yaml", f"resume={name}.safetensors", "hydra.run.dir=again", folder=records)
    arrays = [np.load(path) for path in sorted((records / "again" / "predictions").glob("*.npz"))]
    return np.concatenate([each["predictions"] for each in arrays])[:, 0]


def same(one: float, other: float) -> bool:
    """Equal to the last bit, NaN included."""
    return np.float64(one).tobytes() == np.float64(other).tobytes() or (np.isnan(one) and np.isnan(other))


def health(**values: Any) -> Health:
    """A health that is ok, unless said otherwise."""
    return COMPILING._replace(**{"state": "ok", "sentence": "ok"} | values)


class NotedSession:
    """Takes what a shell gives to a session, and notes it."""

    def __init__(self, sources: dict[str, Any] | None = None):
        self.sources = sources or {}
        self.setup = Setup(self.sources, {"dt": 0.25})
        self.pushed: list[tuple[str, float, float]] = []
        self.dropped: list[tuple[str, str]] = []
        self.restarts: Any = 0
        self.last, self.closed = None, 0
        self.health = health()
        self.steps: list[Any] = []  # what the next push returns
        self.answers: list[str] = []  # to alarms

    def start(self) -> None: ...

    def answer(self, text: str) -> str:
        return f"answer to {text}"

    def answer_alarm(self, answer: str) -> bool:
        self.answers.append(answer)
        return bool(answer)

    def push(self, part: str, stamp: float, raw: float) -> list[Any]:
        self.pushed.append((part, stamp, raw))
        steps, self.steps = self.steps, []
        return steps

    def drop(self, part: str, cause: str) -> None:
        self.dropped.append((part, cause))

    def restart(self) -> list[Any]:
        self.restarts += 1
        return []

    def tick(self) -> Any:
        return self.health

    def close(self) -> None:
        self.closed += 1

    def numbers(self, part: str) -> list[float]:
        return [raw for name, _, raw in self.pushed if name == part]
