"""Simulated changes of boats: errors of the predictors in the first minute, and alarms of the thruster monitor.

Boats of five plants (`usvlearn/simulate`) sail with random commands, as a convoy whose speed a PI controller holds, and
mow a lawn under the same controller. Something changes in minute 10. `benchmarks/stress.py` shows the tables.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import stress
import torch
from peers.online import Peer, plain_nlms, plain_rls
from seasons import NOMINAL, PLANTS

from usvlearn import Ensemble, Persistence
from usvlearn.core.events import NINETY
from usvlearn.core.samples import Fleet, Sample, masks, tree_map
from usvlearn.engine.rollouts import rollout, tensors
from usvlearn.estimators.ensemble.accommodation.layer import thrust_remaining
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.fault import SIDES, Fault
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.sensors import Sensors

DT, MINUTE, LATER = 0.4, 10.0, 300  # s; of the change; steps after it at which the effectiveness is judged, 2 min
FIRST, WINDOW, BACK = 100, 50, 1.1  # predictions judged; steps of the running mean; times its level where it is back
DRIVES = {"random": "random", "speed controller": "convoy", "lawn mowing": "lawn_mower"}  # kinds of mission
EXACT = Sensors(surge_noise=0.0, surge_quantum=1e-9, surge_filtered=0.0, outlier_share=0.0, heading_noise=0.0)
PEERS = {"NLMS": plain_nlms, "RLS": plain_rls}
HEALTH = tuple(f"monitors.thrusters.{name}" for name in ("evidence", "share", "deviation", "raised"))
GIVEN = tuple(f"accommodation.{name}" for name in ("handed", "share", "deviation"))
LONGEST = 500  # steps after the event within which a predictor recovers, or never


class Event(NamedTuple):
    """What happens."""

    options: Mapping[str, Any]  # of `fleet`
    side: str | None = None  # whose thruster weakens
    share: float = 1.0  # of its thrust that is left
    minutes: float = 15.0  # of the mission


class Course(NamedTuple):
    """One event on one kind of mission: all boats of a plant."""

    samples: Sample  # tensors (time, boats)
    target: torch.Tensor  # (time, boats) m/s, what would have been measured, had the sensor worked; NaN: not judged
    true: torch.Tensor  # (time, boats) m/s, predicted by who knows the boat, the wind and the water
    begin: int  # step of the event


class Answer(NamedTuple):
    """What was made of an event: per boat."""

    errors: dict[str, np.ndarray]  # (time, boats) m/s; of the true model, too
    begin: int  # step of the event
    delay: np.ndarray  # (boats,) s until the first alarm after the event, infinite where there is none
    right: np.ndarray  # (boats,) whether the alarm named the side that weakened
    effect: np.ndarray  # (boats,) effectiveness of the side two minutes later, less the truth
    deviation: np.ndarray  # (boats,) its standard deviation


def events() -> dict[str, Event]:
    """All of them by name."""
    named = {
        f"{side} {share:.0%}": Event({"fault": Fault(side, share, MINUTE)}, side, share)
        for side in SIDES
        for share in (0.7, 0.4, 0.0)
    }
    one = {"per_hour": 0.0, "minute": MINUTE, "seconds": (30.0, 30.0)}
    return named | {
        "left +50 %": Event({"fault": Fault("left", 1.5, MINUTE)}, "left", 1.5),
        "wear to 40 %": Event({"fault": Fault("left", 0.4, MINUTE, over=10.0)}, "left", 0.4, 25.0),
        "towed body": Event({"fault": Fault(share=1.0, minute=MINUTE, drag=1.5)}),
        "load": Event({"fault": Fault(share=1.0, minute=MINUTE, mass=1.3)}),
        "gust": Event({"gusts": Gusts(**one)}),
        "stuck speed": Event({"sensors": Sensors(stuck=(60 * MINUTE, 20.0))}),
    }


def course(event: Event, drive: str, plant: str, seed: int, n: int) -> Course:
    """The event on one kind of mission, seen by its sensors, by sensors that work, and by some without errors."""
    season = {
        "n": n, "plant": plant, "seed": seed, "hours": event.minutes / 60, "mission_minutes": event.minutes,
        "missions": (DRIVES[drive],), "aborted_share": 0.0, "paused_share": 0.0, "sensors": Sensors(), **event.options,
    }  # fmt: skip
    every: dict[Sensors, Any] = dict.fromkeys((season["sensors"], Sensors(), EXACT))  # equal ones once
    for sensors in every:
        every[sensors] = align_fleet(fleet(**season | {"sensors": sensors}), dt=DT, patience=1.0).runs[0].samples
    seen, working, exact = (every[sensors] for sensors in (season["sensors"], Sensors(), EXACT))
    learns, known = masks(working).learns, np.isfinite(working.surge)
    off, last = np.where(known, working.surge - exact.surge, np.nan), np.zeros(known.shape[1])
    before = np.empty_like(off)  # error of the last speed that was measured
    for k in range(len(off)):
        before[k], last = last, np.where(known[k], off[k], last)
    return Course(
        tensors(seen, torch.float64),
        torch.from_numpy(np.where(learns, working.surge, np.nan)),
        torch.from_numpy(exact.surge + before),
        round(60 * MINUTE / DT),
    )


@cache
def estimator(plant: str) -> Ensemble:
    """The default ensemble, told the boat's nominal mass and top speed."""
    return stress.default_ensemble(*NOMINAL[plant])


def answer(event: Event, course: Course, plant: str, peers: Mapping[str, Callable[[], Peer]] = PEERS) -> Answer:
    """What the members, the ensemble, peers and the monitor make of a course."""
    ensemble, boats = estimator(plant), course.samples.surge.shape[1:]
    with torch.no_grad():
        wanted = ("predictions", *HEALTH, *GIVEN)
        _, _, recorded = rollout(ensemble, ensemble.init(boats), course.samples, wanted)
        predictions = {name: recorded["predictions"][..., k] for k, name in enumerate(ensemble.names)}
        predictions["true model"] = course.true
        predictions["persistence"] = rollout(Persistence(), Persistence().init(boats), course.samples)[1]
    for name, make in peers.items():
        predictions[name] = torch.stack([stress.follow(make(), one) for one in alone(course.samples)], -1)
    errors = {name: (x - course.target).abs().numpy() for name, x in predictions.items()}
    at = course.begin + LATER if event.minutes <= 15 else -WINDOW
    side = SIDES.index(event.side or "left")
    state = ensemble.init(())
    health = state.monitors.thrusters._replace(**{name.rpartition(".")[2]: recorded[name][at] for name in HEALTH})
    given = state.accommodation._replace(**{name.rpartition(".")[2]: recorded[name][at] for name in GIVEN})
    effect, deviation = (x[:, side].numpy() for x in thrust_remaining(health, given))
    raised = alarms(recorded["monitors.thrusters.raised"].numpy(), course.begin, side)
    return Answer(errors, course.begin, *raised, effect - event.share, deviation)


def alone(samples: Sample) -> Iterator[Sample]:
    """Each boat's samples as peers get them: with the last known speed where a segment starts without one."""
    surge, learns = samples.surge.clone(), masks(samples).learns
    surge[0] = surge[0].nan_to_num()
    for k in range(1, len(surge)):
        surge[k] = torch.where(surge[k].isfinite(), surge[k], surge[k - 1])
    for boat in range(surge.shape[1]):
        yield tree_map(lambda x, boat=boat: x[:, boat], samples._replace(surge=surge, measured=learns))


def alarms(raised: np.ndarray, begin: int, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Delay, s, and whether the side is right; `raised` is `(time, boats, sides)`."""
    later = np.diff(raised, axis=0, prepend=0)[begin:] > 0
    first, there = later.any(2).argmax(0), later.any((0, 2))
    named = np.take_along_axis(later, first[None, :, None], 0)[0]
    delay = np.where(there, np.round(DT * (first + 1), 9), math.inf)
    return delay, there & named[:, side] & ~named[:, 1 - side]


def joined(parts: Sequence[Answer]) -> Answer:
    """The boats of several plants side by side, all as long as the shortest."""
    least = min(len(each.errors["true model"]) for each in parts)
    return Answer(
        {name: np.concatenate([each.errors[name][:least] for each in parts], 1) for name in parts[0].errors},
        parts[0].begin,
        *(np.concatenate([each[k] for each in parts]) for k in range(2, 6)),
    )


def ratio(reply: Answer, name: str) -> float:
    """The mean error of the first predictions over that of the true model."""
    part = slice(reply.begin, reply.begin + FIRST)
    return float(np.nanmean(reply.errors[name][part]) / np.nanmean(reply.errors["true model"][part]))


def steps_back(reply: Answer, name: str) -> float:
    """Steps until the running error stays within BACK times the true model's, or times what it was of it before."""
    window = np.ones(WINDOW)
    ours, true = (np.convolve(np.nan_to_num(reply.errors[key]).sum(1), window, "valid") for key in (name, "true model"))
    share, begin = ours / true, reply.begin
    before = float(np.mean(share[begin - 10 * WINDOW : begin - WINDOW]))
    beyond = np.flatnonzero(share[begin : begin + LONGEST] > BACK * max(1.0, before))
    back = float(beyond[-1]) + 1 if len(beyond) else 0.0
    return back if back < LONGEST else math.inf


def cells(event: Event, reply: Answer) -> dict[str, str]:
    """A row of the table."""
    row = {}
    for name in ("joint", "joint_averaged", "ensemble", *PEERS, "persistence"):
        if name in reply.errors:
            back = steps_back(reply, name)
            row[name] = f"{ratio(reply, name):.2f}, " + ("never" if math.isinf(back) else f"{back:.0f}")
    there, weakens = np.isfinite(reply.delay), event.side is not None and event.share < 1
    delays = np.quantile(reply.delay, (0.5, 0.9), method="higher")
    row["alarm"], row["in 90 %"] = ("–" if math.isinf(x) else f"{x:.0f} s" for x in delays)
    row["boats"] = f"{there.mean():.0%}"
    row["side right"] = f"{reply.right[there].mean():.0%}" if weakens and there.any() else ""
    row["effect ± .10"] = f"{(abs(reply.effect) <= 0.1).mean():.0%}" if weakens else ""
    row["interval holds"] = f"{(abs(reply.effect) <= NINETY * reply.deviation).mean():.0%}" if weakens else ""
    return row


def answers(
    seed: int,
    n: int,
    names: Sequence[str] = (),
    plants: Sequence[str] = PLANTS,
    peers: Mapping[str, Callable[[], Peer]] = PEERS,
    drives: Sequence[str] = tuple(DRIVES),
) -> Iterator[tuple[str, str, Event, Answer]]:
    """What is made of every event on every kind of mission, all plants together."""
    for name, event in events().items():
        for drive in drives if not names or name in names else ():
            parts = [
                answer(event, course(event, drive, plant, 10 * seed + k, n), plant, peers)
                for k, plant in enumerate(plants)
            ]
            yield name, drive, event, joined(parts)


def false_alarms(seed: int, hours: float, n: int, plants: Sequence[str] = PLANTS) -> tuple[int, float]:
    """Alarms on boats to which nothing happens but gusts, on all kinds of missions, and the hours of all of them."""
    watcher, count, total = Ensemble({"persistence": Persistence()}), 0.0, 0.0
    for k, plant in enumerate(plants):
        logs: Fleet = align_fleet(
            fleet(n=n, hours=hours, plant=plant, seed=10 * seed + k, gusts=Gusts()), dt=DT, patience=1.0
        )
        state = watcher.init((n,))
        with torch.no_grad():
            for run in logs.runs:
                state = rollout(watcher, state, tensors(run.samples, torch.float64))[0]
                total += sum(run.lengths) * DT / 3600
        count += float(state.monitors.thrusters.alarms.sum())
    return int(count), total


def section(seed: int, n: int, hours: float, names: Sequence[str] = ()) -> list[str]:
    """The part of the page: `n` boats of each plant, and gusts for `hours` of as many boats."""
    rows: list[dict[str, str]] = []
    for name, drive, event, reply in answers(seed, n, names):
        rows.append({"event": name, "commands": drive, **cells(event, reply)})
        print(*rows[-1].values(), sep=" | ", flush=True)
    count, total = false_alarms(seed, hours, n)
    heads = list(rows[0])
    return [
        "## Changes of the boat", "",
        f"{n} boats of each of the plants {', '.join(PLANTS)} of `usvlearn/simulate`, with its sensors, currents and",
        "thrust tables. Something changes in minute 10, while the boats sail with random commands, as a convoy whose",
        "speed a PI controller holds, or mow a lawn under it. No setting was chosen on these seeds.", "",
        f"- A predictor's cell: the mean error of its first {FIRST} predictions after the event, over that of the true "
        "model, which knows boat, wind and water; and after how many steps its running error "
        f"({WINDOW} steps of all boats) stays within {BACK} × the true model's, or × their ratio before the event.",
        "- `NLMS` and `RLS` (forgetting 0.995) are the plain ones, on the regressors of above.",
        "- Alarm: s until the first one, in half of the boats, and in 90 %; –: not in as many. The share of boats with "
        "one within the mission, and in how many of them it names the side.",
        "- ± .10: share of the boats whose effectiveness is right within .10 two minutes after the event (wear: at the "
        "end), as the event's message shows it. Its 90 % interval holds the truth in the share of boats that is shown.",
        "- Wear takes 10 min. A stuck speed, 20 s long, is judged by the speed that would have been measured.",
        "", f"| {' | '.join(heads)} |", "|---|---|" + "---:|" * (len(heads) - 2),
        *(f"| {' | '.join(row.values())} |" for row in rows),
        "", f"With gusts (20 an hour, up to 40 s, 15 % of the full thrust and 0.1 rad/s) and nothing broken: {count} "
        f"alarms in", f"{total:.0f} h.", "",
    ]  # fmt: skip
