"""The core of the node aboard: messages in, predictions out. It has no clock, reads no file and writes none.

A message is converted to SI units, mixed with others where a command has several sources, and aligned as in a replay
(`usvlearn.logs.alignment.align`). Each sample that it completes is predicted, then learned from. So a recorded session
that is replayed gives the same predictions.

At each step two predictions are published: of the speed that was measured, which judges the model, and of the next
one under the commands in force, which is what planners want. Where the estimator is a `Planar`, it also learns from
heading, yaw rate, sway and position, and makes tracks under the commands in force.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import CHANGE, Event
from usvlearn.core.forecasts import YAW_RATE, Forecast, Track
from usvlearn.core.samples import Inputs, PlanarSample, Sample
from usvlearn.engine.online import Online
from usvlearn.errors import ConfigError, ShapeError
from usvlearn.live import diagnostics
from usvlearn.live.live_poses import LivePoses
from usvlearn.live.plan_requests import PlannedCommands, Point, answer, parse_plan, points, sampled
from usvlearn.live.service_intervals import ServiceIntervals
from usvlearn.logs.alignment.mixing import LiveMix, Mix
from usvlearn.logs.channels.channel import CHANNELS, SURGE
from usvlearn.logs.channels.derived_surge import LiveSurge, pair_of
from usvlearn.logs.setup import Setup

PATIENCE = 0.1  # s, for which a live step waits for late messages
LONGEST = 600  # steps of a forecast, at most
LATEST = 1e12  # s: a stamp of this size is none
Ends = dict[float, tuple[float, float, float]]  # horizon, s -> surge and ends of its interval, m/s


class Step(NamedTuple):
    """One step of the grid. A number is NaN where it is not known."""

    time: float  # of its end, s, as the messages are stamped
    measured: float  # m/s
    speed: float  # that was predicted of it, m/s, and the ends of its 90 % interval
    low: float
    high: float
    next: float  # of the next step under the commands in force, likewise
    next_low: float
    next_high: float
    forecasts: Ends  # under the commands in force, with intervals that hold whatever is commanded meanwhile
    if_held: Ends  # the same, with intervals that hold where the commands stay
    members: dict[str, float]  # the prediction of each member and combiner, m/s
    events: tuple[Event, ...]  # of this step
    track: Track | None = None  # under the commands in force
    places: Mapping[float, Point] = {}  # of it at its horizons, s, with ellipses that hold whatever is commanded
    places_if_held: Mapping[float, Point] = {}  # the same, with ellipses that hold where the commands stay


class Node:
    """Learns from the messages of one boat."""

    def __init__(self, setup: Setup, online: Online, patience: float = PATIENCE):
        self.setup, self.online, self.patience = setup, online, patience
        self.parts, self.one_command = setup.parts, setup.one_command
        self._channels = {part: part.partition("[")[0] for part in self.parts}
        self.steps = self.learned = self.alarms = 0  # how many there were
        self.grid = self.fresh = self.measured = 0  # steps of the grid, those with all inputs, those with a speed, too
        self.alarm: str | None = None  # the side whose thruster seems to have failed
        self.loss: Event | None = None  # what is known of it now
        self.changed = ""  # what the last change of the boat has changed
        self._full = self._before_change = math.nan  # m/s, at full command: the last known, and before a change
        self._shell: dict[str, Counter[str]] = {}
        self._before: dict[str, Counter[str]] = {}  # counts of earlier aligners
        description = online.description
        if description is None:
            raise ConfigError("estimator: found one without compiled code, expected one that has it")
        surge, _ = diagnostics.surge_of(online)
        self._output = str(surge.get("output"))
        self._watch = diagnostics.event_watch(surge)
        self.origin = math.nan  # stamps are counted from here, s
        self.derived: float | None = None  # m/s, the surge that the last message completed
        # Is called with channel, time and value, s and SI units, of each message that is aligned.
        self.took: Callable[[str, float, float], None] = lambda *_: None
        self.dt = float(setup.align["dt"])
        self.horizons, self.track_horizons = (  # s, of forecasts and of tracks
            tuple(each for each in horizons if round(each / self.dt) <= LONGEST)
            for horizons in (diagnostics.horizons(surge), diagnostics.track_horizons(description))
        )
        # The intervals of forecasts, whatever is commanded.
        self.held = ServiceIntervals(self.horizons, self.dt)
        self.tracks = [ServiceIntervals(self.track_horizons, self.dt, 2, held) for held in (False, True)]
        self.last = math.nan  # the end of the last step, s, as the messages are stamped
        self._begin()

    def _begin(self) -> None:
        """A new grid of time."""
        setup = self.setup
        self._aligner = setup.aligner(patience=self.patience)
        for each in (self.held, *self.tracks):
            each.clear()
        self._mixes = {name: LiveMix(each) for name, each in setup.channels.items() if isinstance(each, Mix)}
        pair = None if SURGE in setup.channels else pair_of(setup.channels)
        self._derived = None if pair is None else LiveSurge(pair, setup.channels["heading"].held)  # type: ignore[union-attr]
        self._poses = LivePoses(self.parts) if self.track_horizons else None
        self.origin = math.nan

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        total: dict[str, Counter[str]] = {}
        for source in (self._shell, self._before, self._aligner.rejected):
            for channel, causes in source.items():
                total.setdefault(channel, Counter()).update(causes)
        return {channel: dict(causes) for channel, causes in total.items()}

    @property
    def windows(self) -> dict[str, tuple[float, float]]:
        """See `Aligner.windows`."""
        return self._aligner.windows

    def drop(self, part: str, cause: str, count: int = 1) -> None:
        """Count messages that could not be used."""
        self._shell.setdefault(self._channels.get(part, part), Counter())[cause] += count

    def warm(self) -> None:
        """Compile all that a step needs, so that none waits for it."""
        if self.horizons:
            self.online.forecast([[0.0, 0.0]], 0.0, 0.0, 0.4)
        if self.track_horizons:
            self.online.forecast([[0.0, 0.0]])

    def relative(self, stamp: float) -> float:
        """A stamp as the aligner counts it, s since the beginning of the segment."""
        if math.isnan(self.origin):
            self.origin = float(math.floor(stamp))
        return stamp - self.origin

    def push(self, part: str, stamp: float, raw: float) -> list[Step]:
        """Take a message of a part (`Setup.parts`), stamped in s of any clock; returns the steps that it completes."""
        source = self.parts.get(part)
        if source is None:
            raise ConfigError(f"part: found {part!r}, expected one of {', '.join(self.parts)}")
        if not abs(stamp) < LATEST:
            self.drop(part, "no_time")
            return []
        if not math.isfinite(raw) or raw in source.missing:
            self.drop(part, "not_a_number")
            return []
        time, channel = self.relative(stamp), self._channels[part]
        value = float(source.convert(np.float64(raw)))  # type: ignore[arg-type]
        if (mix := self._mixes.get(channel)) is not None:
            mixed = mix.push(int(part[len(channel) + 1 : -1]), time, value)
            if mixed is None:
                self.drop(part, "alone")
                return []
            value = mixed
        if self._poses is not None:
            self._poses.take(channel, time, value)
        steps = self._feed(channel, time, value) if channel in CHANNELS else []
        self.derived = None
        if self._derived is not None and (channel == "heading" or channel in self._derived.pair):
            self.derived = self._derived.push(channel, time, value)
            if self.derived is not None:
                steps += self._feed(SURGE, time, self.derived)
        return steps

    def _feed(self, channel: str, time: float, value: float) -> list[Step]:
        self.took(channel, time, value)
        return [self._step(at, sample) for at, sample in self._aligner.push(channel, time, value)]

    def finish(self) -> list[Step]:
        """Make the steps up to the newest message, without waiting for late ones."""
        return [self._step(at, sample) for at, sample in self._aligner.flush()]

    def restart(self) -> list[Step]:
        """Begin anew, because the clock of the stamps began anew; returns the last steps before that."""
        steps = self.finish()
        for channel, causes in self._aligner.rejected.items():
            self._before.setdefault(channel, Counter()).update(causes)
        self._begin()
        return steps

    def _step(self, time: float, sample: Sample) -> Step:
        """Predict, learn, and look ahead."""
        learnt: Sample | PlanarSample = sample
        if self._poses is not None:
            learnt = PlanarSample(sample, *self._poses.at(time, sample).tolist())
        predicted = float(self.online.step(learnt))
        stepped = math.isfinite(predicted)
        self.grid += 1
        self.fresh += bool(sample.fresh)
        self.measured += bool(sample.measured)
        self.steps += stepped
        self.learned += bool(stepped and sample.measured)
        every: Any = self.online.last_predictions() if stepped and self.online.names else {}
        members = {name: surge for name, (surge, _) in every.items()}
        width = every[self._output][1] if every else math.nan
        events = self._events(time + self.origin) if stepped else ()
        self.held.take(time, np.array([sample.surge if sample.measured else math.nan]))
        after, after_width, forecasts, if_held, track = self._outlook()
        self.held.expect(time, {horizon: surge for horizon, (surge, _, _) in if_held.items()})
        places, places_if_held = self._places(time, learnt, track)
        self.last = time + self.origin
        return Step(
            self.last,
            sample.surge if sample.measured or sample.inputs.dt == 0 else math.nan,
            predicted, predicted - width, predicted + width,
            after, after - after_width, after + after_width,
            forecasts, if_held, members, events, track, places, places_if_held,
        )  # fmt: skip

    def _outlook(self) -> tuple[float, float, Ends, Ends, Track | None]:
        """The next speed under the commands in force, the half-width of its interval, the forecasts, and the track."""
        last = max((*self.horizons, *self.track_horizons), default=0.0)
        steps = max(round(last / self.dt), 1)
        ahead = self._aligner.ahead(steps)
        first = Inputs(*(float(x[0]) for x in ahead))
        if not all(map(math.isfinite, first)):
            return math.nan, math.nan, {}, {}, None
        if self.online.names:
            foreseen: Any = self.online.predict_members(first)
            surge, width = foreseen[self._output]
        else:
            surge, width = self.online.predict(first), math.nan
        forecasts, if_held = {}, {}
        if self.horizons:
            forecast = self._forecast(ahead.command_left, ahead.command_right, ahead.heading, ahead.yaw_rate)
            for horizon in self.horizons:
                k = max(round(horizon / self.dt), 1) - 1
                speed, half = float(forecast.surge[k]), self.held.halfwidth(horizon)
                if_held[horizon] = speed, float(forecast.low[k]), float(forecast.high[k])
                forecasts[horizon] = speed, speed - half, speed + half
        track = self._track(ahead.command_left, ahead.command_right) if self.track_horizons else None
        return float(surge), float(width), forecasts, if_held, track

    def _places(
        self, time: float, sample: Sample | PlanarSample, track: Track | None
    ) -> tuple[dict[float, Point], dict[float, Point]]:
        """Places of a track with ellipses of both kinds, which learn from where the boat is now."""
        if not isinstance(sample, PlanarSample):
            return {}, {}
        inputs = sample.sample.inputs
        now, commands = np.array([sample.north, sample.east]), np.array([inputs.command_left, inputs.command_right])
        for each in self.tracks:
            each.take(time, now, commands)
        if track is None:
            return {}, {}
        steps = [max(round(horizon / self.dt), 1) for horizon in self.track_horizons]
        ahead = dict(zip(self.track_horizons, points(track, steps), strict=True))
        expected = {horizon: np.add(now, point[:2]) for horizon, point in ahead.items()}
        for each in self.tracks:
            each.expect(time, expected, float(inputs.heading), commands)
        whatever, held = (each.put(ahead, float(inputs.heading)) for each in self.tracks)
        return whatever, {h: point if math.isfinite(point.major) else ahead[h] for h, point in held.items()}

    def _track(self, left: Any, right: Any) -> Track:
        """Where the boat will be under commands within full scale."""
        return self.online.forecast(np.clip(np.stack([left, right], -1), -1.0, 1.0), dt=self.dt)

    def _forecast(self, left: Any, right: Any, headings: Any, yaw_rates: Any) -> Forecast:
        """A forecast of commands within full scale."""
        commands = np.clip(np.stack([left, right], -1), -1.0, 1.0)
        return self.online.forecast(commands, headings, np.clip(yaw_rates, -YAW_RATE, YAW_RATE), self.dt)

    def compare_full_speed(self, speed: float) -> None:
        """Take the identified speed at full command, m/s, and say what the last change has made of it."""
        if not math.isfinite(speed):
            return
        self._full, more = speed, speed / self._before_change - 1
        if math.isfinite(more):
            way = "slower" if more < 0 else "faster"
            self.changed = f"since it has changed, the boat is {way} at the same command by {100 * abs(more):.0f} %"

    def reset_alarm(self, below: bool = True) -> None:
        """Forget alarms and their evidence, by default also that below; the filters keep what they have learned."""
        begin, leaves = diagnostics.surge_of(self.online)[1], self.online.state
        names = [f"{begin}monitors.thrusters.{name}" for name in ("evidence", "sums", "held", "together", "raised")]
        names.append(f"{begin}accommodation.handed")
        if below or any(np.any(leaves.get(name, 0.0)) for name in names[-2:]):
            self.online.state = leaves | {name: np.zeros_like(leaves[name]) for name in names if name in leaves}

    def answer(self, text: str) -> str:
        """The answer to a plan that was posted (`usvlearn.live.plan_requests`): a forecast, or why there is none.

        A plan that cannot be used is counted; nothing is raised.
        """
        try:
            forecast: Forecast | Track | str = self._planned(parse_plan(text))
        except (ConfigError, ShapeError) as error:
            self.drop("plan", "refused")
            forecast = str(error)
        return answer(text, self.last, forecast)

    def _planned(self, plan: PlannedCommands) -> Forecast | Track:
        last = float(plan.time[-1]) / self.dt  # steps until then; infinite where t is as large as numbers go
        if last >= LONGEST:
            raise ConfigError(f"plan: found t {plan.time[-1]:g}, expected at most {(LONGEST - 1) * self.dt:g} s")
        least = round(max((*self.horizons, *self.track_horizons), default=0.0) / self.dt)
        steps = max(least, math.floor(last) + 1)
        ahead = self._aligner.ahead(steps)
        if not all(math.isfinite(float(x[0])) for x in ahead):
            raise ConfigError(
                "plan: no forecast can be made now, because inputs are missing: see the state of the node"
            )
        edges, sources = self.dt * np.arange(steps + 1), self.setup.aligned
        left, right = (  # a command takes effect after its delay
            sampled(plan, edges - sources[f"command_{side}"].delay, ahead[k], side)
            for k, side in enumerate(("left", "right"))
        )
        if plan.heading is None and self.track_horizons:
            return self._track(left, right)
        if plan.heading is None:
            return self._forecast(left, right, ahead.heading, ahead.yaw_rate)
        time, heading = plan.time, np.asarray(sources["heading"].convert(plan.heading))
        if time[0] > 0:
            time, heading = np.append(0.0, time), np.append(ahead.heading[0], heading)
        headings = np.interp(edges, time, np.unwrap(heading))
        return self._forecast(left, right, headings[:-1], np.diff(headings) / self.dt)

    def _events(self, time: float) -> tuple[Event, ...]:
        """The events of this step, at `time`, s."""
        if self._watch is None:
            return ()
        events = self._watch.see(time, diagnostics.event_row(self.online, self._watch.filters))
        losses = sorted(self._watch.losses.values(), key=lambda event: event.effectiveness)
        self.loss = losses[0] if losses else None
        self.alarm = self.loss and self.loss.side
        self.alarms += sum(event.is_alarm for event in events)
        if any(event.kind == CHANGE for event in events):
            self._before_change, self.changed = self._full, ""
        return tuple(events)
