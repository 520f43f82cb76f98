"""Runs a node: its folder, its clock, the thread that compiles and the one that writes.

What the middlewares share. It is called from one thread.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import usvlearn
from usvlearn.core.lock import Lock
from usvlearn.engine.parts import external_in
from usvlearn.engine.validate import afresh
from usvlearn.live import diagnostics
from usvlearn.live.alarms import Alarms
from usvlearn.live.background import Background
from usvlearn.live.displays import Displays
from usvlearn.live.frozen_sensors import FrozenSensors
from usvlearn.live.health import COMPILING, ONE_COMMAND, Health, Listening, Pace, Usable
from usvlearn.live.message_buffer import Recent
from usvlearn.live.missions import Missions
from usvlearn.live.node_folder import NodeFolder, unsaved
from usvlearn.live.plan_requests import answer
from usvlearn.live.recorder import Recorder
from usvlearn.live.start import Begin, Middleware, Options, begin
from usvlearn.live.status import of_last
from usvlearn.logs.channels.channel import SURGE, Source
from usvlearn.logs.setup import KEY

if TYPE_CHECKING:
    from usvlearn.live.node import Node, Step

HELD, TRACKS = "held", ("tracks", "tracks_if_held")  # of a checkpoint's metadata: errors of forecasts and of tracks
REPORT = 5.0  # s between two reports of what is identified and of the networks
TELL = 10.0  # s between two status files
RETRY = 60.0  # s after a save that failed, at most
FIRST_CHECK = 60.0  # s after the start, of the data, and after one that found something; else at each save
WARNINGS = 20  # sentences, at most


class Session:
    """One node aboard; no other node may have its folder."""

    def __init__(self, options: Options, middleware: Middleware):
        self.options, self.middleware = options, middleware
        self._made = [each for each in (options.folder, *options.folder.parents) if not each.exists()]
        self._lock = Lock(options.folder, "folder of the node")
        try:
            self._folder = NodeFolder(options.folder, options.keep)
            self._begin: Begin = begin(self._folder, options, middleware)
            self.setup = self._begin.setup
            self.setup.check_live()
            self._displays = Displays(options)
        except BaseException:
            self._release()
            raise
        self.sources: dict[str, Source] = self.setup.parts  # part -> what is received
        needed = self.setup.live().parts  # what tracks alone need is not waited for
        self._listening = Listening(needed, options.warp)
        self._usable, self._pace, self._frozen = Usable(needed), Pace(options.warp), FrozenSensors(self.sources)
        self.sentence = self._begin.sentence
        self.one_command = self.setup.one_command  # a middleware may find it out later
        self.state = "compiling"
        self.last: Step | None = None
        self._node: Node | None = None
        self._failure: BaseException | None = None
        self._thread: threading.Thread | None = None
        self._recorder: Recorder | None = None
        self._recent = Recent(self.setup)
        self._background = Background()
        self._alarms = Alarms(options.folder)
        self._missions = Missions(options, self.setup, self._recent, self._background)
        self._began = time.monotonic()
        self._early: Counter[tuple[str, str]] = Counter()  # part and cause of messages that came before it was ready
        self._saved, self._due = -math.inf, self._began  # when a checkpoint was saved, and when the next period begins
        self._reported = self._told = -math.inf
        self._closed, self._check_due = False, self._began + FIRST_CHECK
        self._learned = self._hoped = 0  # at the last save, and at the one that is being made
        self._warnings: dict[str, str] = {f"set {k}": each for k, each in enumerate(self._begin.warnings)}
        self._unexplained = ""  # why turns tell nothing of the thrusters
        self.sentence += self._displays.sentence
        self._contraction: dict[str, dict[str, Any]] = {}
        self._identified: dict[str, tuple[float, float, float, str]] = {}

    # what the shell calls

    def start(self) -> None:
        """Begin to compile, or to load compiled code, in a thread."""
        self._thread = threading.Thread(target=self._make, name="usvlearn-compile", daemon=True)
        self._thread.start()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the node is ready, s; returns whether it is."""
        if self._thread is not None:
            self._thread.join(timeout)
        return self._ready()

    def push(self, part: str, stamp: float, raw: float) -> list[Step]:
        """Take one message; returns the steps that it completes. See `Node.push`."""
        self._listening.take(part)
        if self.state == "compiling" and not self._ready():
            self._early[part, "compiling"] += 1
            return []
        node = self._node
        assert node is not None
        if self._frozen.take(part, stamp, raw):
            node.drop(part, "frozen")
            return []
        steps = node.push(part, stamp, raw)
        if self._recorder is not None and math.isfinite(stamp):
            self._recorder.write(part, node.relative(stamp), raw)
            if node.derived is not None:
                self._recorder.write(SURGE, node.relative(stamp), node.derived)
        self._took(steps)
        return steps

    def answer(self, text: str) -> str:
        """The answer to a plan. See `Node.answer`."""
        if self._node is None or self.state == "compiling":
            self.drop("plan", "compiling")
            return answer(text, math.nan, f"plan: no forecast can be made yet: {COMPILING.sentence}")
        return self._node.answer(text)

    def answer_alarm(self, answer: str) -> bool:
        """Take "acknowledge" or "reset"; returns whether it is one of them."""
        if not (known := self._alarms.ask(answer)):
            self.drop("alarm", "refused")
        return known

    def advise(self, name: str, sentence: str) -> None:
        """Warn of something that the shell has noticed; an empty sentence ends the warning of that name."""
        self._warnings = {key: each for key, each in self._warnings.items() if key != name}
        self._warnings |= {name: sentence} if sentence else {}

    def drop(self, part: str, cause: str) -> None:
        """Count a message that the shell could not use."""
        if self._node is not None:
            self._node.drop(part, cause)
        else:
            self._early[part, cause] += 1

    def restart(self) -> list[Step]:
        """The clock of the stamps began anew: a new segment, and a new record."""
        if self._node is None:
            return []
        steps = self._node.restart()
        self._took(steps)
        self._missions.keep(ended=True, anew=True)
        if self._recorder is not None:
            self._record()
        return steps

    def tick(self, clock: float | None = None) -> Health:
        """The health, once a second; saves what is due. `clock` is `time.monotonic()`."""
        clock = time.monotonic() if clock is None else clock
        ages = self._listening.ages(clock)
        if not self._ready():
            health = COMPILING._replace(uptime=clock - self._began, ages=ages, warnings=self.warnings)
            self._displays.health(health, None, ready=False)
            return health
        node = self._node
        assert node is not None
        self._finished()
        self._alarms.obey(node)
        for part, sentence in self._frozen.warnings.items():
            self.advise(f"frozen {part}", sentence)
        if self._recorder is not None:
            self._recorder.flush(clock)
            self.advise("record", self._recorder.problem or "")
        if clock - self._reported >= REPORT:
            self._reported = clock
            self._look()
        outage = min(ages.values(), default=math.inf) > float(self.setup.align.get("outage", 5.0))
        if saves := clock - self._due >= self.options.save_period or (outage and node.learned > self._learned):
            self._save_soon(clock)
        elif clock >= self._check_due:
            self._check()
        self.advise("fit", self._missions.tick(saves, outage, node.loss))
        refit, before = self._missions.told, diagnostics.fit_of(node.online.description)
        if refit is not None and (fit := (refit.table or before) if refit.use else (0.0,) * len(before)) != before:
            node.online.take_fit(fit)
        self.advise("ended", "; ".join(node.online.ended.values()))
        health = self._health(ages, clock)
        self.state = health.state
        if clock - self._told >= TELL and self._background.submit("status", self._tell, health.json()):
            self._told = clock
        self._displays.health(health, self.last)
        return health

    def save(self) -> Path | None:
        """Write a checkpoint now; None before the node is ready, or if it could not be written."""
        if self._node is None:
            return None
        try:
            path = self._folder.save(*self._checkpoint())
        except OSError as error:
            self._warnings["save"] = unsaved(self.options.folder, error)
            return None
        self._saved, self._learned = time.monotonic(), self._node.learned
        return path

    def close(self) -> str:
        """Make the last steps, save, end the record, release the folder; returns a sentence on what was saved."""
        if self._closed:
            return ""
        self._closed = True
        try:
            return self._end()
        finally:
            if self._recorder is not None:
                self._recorder.close()
            self._displays.close()
            self._background.close()
            self._release()

    def _release(self) -> None:
        """Release the folder; what this session has made of it and left empty is removed."""
        self._lock.release()
        with suppress(OSError):  # it is not empty
            for path in self._made:
                path.rmdir()

    def _end(self) -> str:
        node = self._node
        if node is None:
            return "ends; it was not ready yet"
        self._took(node.finish())
        self._background.wait()
        self._finished()
        if node.learned > self._learned:
            self.save()
        self._missions.tick(False, True, node.loss)
        self._look()
        clock = time.monotonic()
        with suppress(OSError):
            self._tell(self._health(self._listening.ages(clock), clock).json() | {"state": "ended"})
        if node.learned > self._learned:
            return f"ends; {self._warnings.get('save', 'what it learned last could not be saved')}"
        return "saved; ends" if node.learned else "ends; it has learned nothing"

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about what is wrong now."""
        shown = (each for each in self._displays.warnings.values() if each)
        return (*self._warnings.values(), *shown)[:WARNINGS]

    # inside

    def _make(self) -> None:
        """Make the node; in a thread, because compiling takes minutes on a small computer."""
        try:
            from usvlearn.engine.online import Online
            from usvlearn.live.node import Node
            from usvlearn.live.trusted_members import trusted_members, without

            leaves, facts = self._begin.leaves, self._begin.facts
            members = trusted_members(facts, self.options.trust)
            node = Node(self.setup, Online.of(leaves, facts, members), self.options.patience)
            self.advise("members", without(facts, members))
            node.warm()
            for name, each in zip((HELD, *TRACKS), (node.held, *node.tracks), strict=True):
                each.load(self._begin.facts.get(name))
            node.reset_alarm(below=False)  # that of an earlier session may be over, or false
            node.took = self._recent.add
            self._node = node
        except BaseException as error:  # told by the thread that owns the session
            self._failure = error

    def _ready(self) -> bool:
        """Whether the node is ready; raises what went wrong as it was made."""
        if self._failure is not None:
            raise self._failure
        if self.state != "compiling":
            return True
        if self._node is None:
            return False
        self.state = "waiting"
        self._node.online.setup = self.setup.json()
        for (part, cause), count in self._early.items():
            self._node.drop(part, cause, count)
        if self.options.record:
            self._record()
        return True

    def _record(self) -> None:
        """Begin a record, with a checkpoint of now."""
        assert self._node is not None
        if self._recorder is not None:
            self._recorder.close()
        self._recorder = Recorder(self.options.folder / "records", self.setup, self._checkpoint(), self.options.boat)

    def _took(self, steps: list[Step]) -> None:
        if steps:
            self.last = steps[-1]
            self._displays.steps(steps)

    def _health(self, ages: Mapping[str, float], clock: float) -> Health:
        node = self._node
        assert node is not None
        state, sentence = self._listening.judged(ages, node.dt, node.windows)
        pace = self._pace.judged(node, clock) if state == "ok" else None
        lost = self._usable.judged(node, ages) or pace
        self.advise("usable", lost.warning if lost else "")
        if lost and state == "ok":
            state, sentence = "sparse", lost.sentence
        counts = f"{node.steps} steps, {node.learned} learned" + (f", {node.alarms} alarms" if node.alarms else "")
        return Health(
            state, f"{sentence}; {counts}", node.counts, dict(ages), node.steps, node.learned, node.alarms, node.alarm,
            clock - self._began, clock - self._saved, self._contraction, self._identified, self.warnings,
            self._notes(node), self._alarms.sentence(node), self._missions.told,
        )  # fmt: skip

    def _notes(self, node: Node) -> tuple[str, ...]:
        """What cannot be known, and what a change of the boat has changed."""
        told = (ONE_COMMAND if self.one_command else "", self._unexplained, node.changed)
        return tuple(each for each in told if each)

    def _checkpoint(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """A checkpoint of now: copies of the leaves, and the metadata."""
        node, begun = self._node, self._begin.facts
        assert node is not None
        tracks = {name: each.json() for name, each in zip(TRACKS, node.tracks, strict=True)}
        facts = {
            "estimator": begun["estimator"], "kernel": node.online.description,
            KEY: self.setup.json(), HELD: node.held.json(), **tracks, "boat": self.options.boat, "run": "live",
            "step": node.steps, "time": 0.0 if self.last is None else self.last.time, "version": usvlearn.__version__,
            "configuration": begun.get("configuration") if external_in(begun["kernel"]) else None,  # how they are made
        }  # fmt: skip
        leaves, sentence = afresh(node.online.state, lambda: self._begin.leaves, node.online.ended)
        if sentence:
            node.online.state = leaves
            node.drop("members", "not_finite")
            self.advise("afresh", sentence)
        return leaves, facts

    def _save_soon(self, clock: float) -> None:
        """Write a checkpoint in the thread, unless one is being written, and check the data."""
        assert self._node is not None
        if self._background.submit("save", self._folder.save, *self._checkpoint()):
            self._due, self._hoped = clock, self._node.learned
            self._check()

    def _check(self) -> None:
        """Check the data in the thread."""
        assert self._node is not None
        self._check_due = math.inf
        arguments = self._recent.copy(), self.options.boat, self._node.horizons
        self._background.submit("check", self._recent.findings, *arguments)

    def _look(self) -> None:
        """What is identified, the networks, and channels of which no message can be used."""
        node = self._node
        assert node is not None
        node.one_command = self.one_command
        self._contraction = diagnostics.networks(node.online)
        self._identified, wrong = diagnostics.identified(node.online, self.one_command)
        self._identified |= self._missions.turning(self._identified)
        self.advise("boat", wrong)
        self._unexplained = "" if self.one_command else diagnostics.unexplained(node.online)
        node.compare_full_speed(self._identified.get("steady_speed_full", (math.nan,))[0])
        self._listening.look(node.counts)

    def _finished(self) -> None:
        """Look at what the thread has done; an error is a warning, and the node learns on."""
        for name, result, error in self._background.done():
            self._warnings = {key: each for key, each in self._warnings.items() if not key.startswith(name)}
            if name == "save" and error is None:
                self._saved, self._learned = time.monotonic(), self._hoped
            elif name == "save":
                self._warnings[name] = unsaved(self.options.folder, error)
                self._due = time.monotonic() - self.options.save_period + min(RETRY, self.options.save_period)
            elif name == "check" and error is None:
                self._warnings |= {f"{name} {k}": each for k, each in enumerate(result)}
                self._check_due = time.monotonic() + FIRST_CHECK if result else math.inf  # it may be over then
            elif error is not None:
                what = {"check": "the data cannot be checked", "status": "the status cannot be written"}
                self._warnings[name] = f"{what.get(name, 'the missions cannot be kept')}: {error}"

    def _tell(self, health: Mapping[str, Any]) -> None:
        last = None if self.last is None else of_last(self.last)
        facts = {
            "middleware": self.middleware.name, "boat": self.options.boat, "began_from": self.sentence,
            "written": time.time(), "last": last,
        }  # fmt: skip
        self._folder.tell({**health, **facts})
