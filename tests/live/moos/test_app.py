"""The app at the stand-in: what it publishes, and that no fault of the database or of a message stops it."""

import asyncio
import contextlib
import errno
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator

import pytest

from tests.support import ROOT
from tests.support.live import boat, messages
from tests.support.moosdb import Moosdb
from usvlearn.errors import ConfigError
from usvlearn.live.moos import client as link
from usvlearn.live.moos import wire
from usvlearn.live.moos.app import App, run
from usvlearn.live.moos.block import MIDDLEWARE, Settings
from usvlearn.live.moos.wire import Message
from usvlearn.live.node_folder import NodeFolder
from usvlearn.live.session import Session
from usvlearn.live.start import Options
from usvlearn.live.status import posts
from usvlearn.live.status.status_file import status_lines

NAMES = {"command_left": "DESIRED_THRUST_L", "command_right": "DESIRED_THRUST_R",
         "heading": "NAV_HEADING", "surge": "NAV_SPEED"}  # fmt: skip
SCALE = {"command_left": 100.0, "command_right": 100.0, "heading": 180 / math.pi, "surge": 1.0}
ASK = "node=usv,app=pUSVLearn,duration=30,key=test,thresh=any"


async def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not come true"
        await asyncio.sleep(0.005)


def prior(folder, **options) -> Options:
    return Options(folder, mass=36.0, surge_max=3.0, **options)


class Sea:
    """A database, a boat that posts there, and the app."""

    def __init__(self, database: Moosdb, app: App):
        self.database, self.app = database, app
        self.began = database.now()
        self._rows: Iterator[tuple[str, float, float]] = messages(boat(), 0.0)
        self.sent = 0

    def sail(self, seconds: float, shift: float = 0.0, leave_out: str = "") -> None:
        """Post what the boat says in the next seconds of its time, at once."""
        end = None
        for part, stamp, value in self._rows:
            if part in NAMES and part != leave_out:
                self.database.post(NAMES[part], SCALE[part] * value, at=self.began + shift + stamp)
                self.sent += 1
            end = stamp + seconds if end is None else end
            if stamp > end:
                return

    def posted(self, name: str) -> list[Message]:
        return [each for each in self.database.posted if each.key == name and each.source == self.app.settings.name]

    def health(self) -> dict[str, str]:
        text = self.posted("USV_HEALTH")[-1].text if self.posted("USV_HEALTH") else ""
        return dict(part.partition("=")[::2] for part in text.split(","))

    async def steps(self, seconds: float = 10.0, **how) -> None:
        """Sail, and wait until the app has made steps of it."""
        before = len(self.posted("USV_SPEED_NEXT"))
        self.sail(seconds, **how)
        await until(lambda: len(self.posted("USV_SPEED_NEXT")) > before + seconds / 2)


@contextlib.asynccontextmanager
async def at_sea(options: Options, database: Moosdb | None = None, **changes) -> AsyncIterator[Sea]:
    """The app beside a database, until the end of the block; it then ends in order."""
    database = database or Moosdb()
    await database.start()
    settings = Settings("pUSVLearn", "127.0.0.1", database.port, database.warp, "usv", 20.0, "USV_", False, options)
    app = App(Session(options, MIDDLEWARE), settings._replace(**changes))
    task = asyncio.create_task(app.main())
    try:
        sea = Sea(database, app)
        await until(lambda: task.done() or app.client.connected)
        yield sea
    finally:
        app.stop()
        database.thaw()
        code = await task
        database.kill()
        await asyncio.sleep(0.02)
    assert code == 0


async def ready(sea: Sea) -> Sea:
    await until(lambda: sea.health().get("state", "compiling") != "compiling", 300)
    sea.began = sea.database.now()
    return sea


def test_it_publishes_what_the_node_says(tmp_path):
    async def work():
        async with at_sea(prior(tmp_path / "moos")) as sea:
            await ready(sea)
            before = sea.database.now()
            await sea.steps(60)
            await until(lambda: sea.posted("USV_PARAMS") and sea.posted("PUSVLEARN_STATUS"))
            return sea, before

    sea, before = asyncio.run(work())
    kinds = {"USV_" + name: kind for name, kind in posts.KINDS.items()}
    own = [each for each in sea.database.posted if each.source == "pUSVLearn"]
    assert not sea.database.refused
    assert all(each.data == kinds[each.key] for each in own if each.key in kinds)
    assert all(before - 60 < each.time < time.time() for each in own)
    expected = []  # the same messages through a session alone
    with Session(prior(tmp_path / "alone"), MIDDLEWARE) as session:
        session.start()
        session.wait()
        variables = {variable: part for part, variable in NAMES.items()}
        for each in sea.database.posted:
            if each.source == "boat":
                expected += session.push(variables[each.key], each.time, each.value)
    for name, values in (
        ("USV_SPEED_PRED", [step.speed for step in expected]),
        ("USV_SPEED_NEXT", [step.next for step in expected]),
        ("USV_SPEED_ERROR", [step.measured - step.speed for step in expected]),
    ):
        assert [each.value for each in sea.posted(name)] == [value for value in values if math.isfinite(value)]
    assert len(sea.posted("USV_SPEED_PRED")) > 100
    assert sea.posted("EXITED_NORMALLY")[-1].text == "pUSVLearn"
    status = sea.posted("PUSVLEARN_STATUS")[-1].text
    assert 50_000 < int(status.partition("memory_kb=")[2].partition(",")[0])
    assert status.startswith("AppErrorFlag=false,Uptime=") and 'Subscribing="APPCAST_REQ,DESIRED' in status
    gaps = [each.value for each in sea.posted("PUSVLEARN_ITER_GAP")]
    assert 0.9 < sorted(gaps)[len(gaps) // 2] < 2.0
    assert list((tmp_path / "moos").glob("live_*.safetensors"))


def test_while_code_compiles_it_answers_and_then_asks_again(tmp_path, monkeypatch):
    compiled = threading.Event()
    make = Session._make
    monkeypatch.setattr(Session, "_make", lambda self: compiled.wait() and make(self))

    async def work():
        database = Moosdb()
        database.post("DESIRED_THRUST_L", 10.0, at=time.time() - 1000)
        async with at_sea(prior(tmp_path), database) as sea:
            await until(lambda: sea.posted("USV_HEALTH"))
            assert sea.health()["state"] == "compiling" and sea.app.client.connected
            assert len(sea.posted("APPCAST")) == 1  # by which a viewer learns of the app
            database.post("APPCAST_REQ", ASK)
            await until(lambda: "State       compiling" in str([each.text for each in sea.posted("APPCAST")]))
            database.post("DESIRED_THRUST_R", 20.0)
            await asyncio.sleep(0.2)
            compiled.set()
            await ready(sea)
            await sea.steps(10, leave_out="command_left")  # posted on change alone, so not again
            counts = sea.app.session._node.counts
            assert sum(causes.get("compiling", 0) for causes in counts.values()) == 2

    asyncio.run(work())


def test_messages_that_are_no_numbers(tmp_path):
    async def work():
        async with at_sea(prior(tmp_path)) as sea:
            await ready(sea)
            await sea.steps(10)
            now = sea.database.values["NAV_SPEED"].time
            for value in (math.nan, math.inf, 1e308, -1e308):
                sea.database.post("NAV_SPEED", value, at=now + 0.01)
            for stamp in (math.nan, math.inf, -math.inf, 1e308):
                sea.database.post("NAV_SPEED", 1.0, at=stamp)
            del sea.database.values["NAV_SPEED"]  # as after a restart: another app may post another type
            for text in ("nan", "1e308", "off", "", " ", "\0", "1.0"):
                sea.database.post("NAV_SPEED", text, at=now + 0.02)
            del sea.database.values["NAV_SPEED"]
            sea.database._accept(Message("N", "NAV_SPEED", wire.BINARY, text="1.0", time=now, source="boat"))
            del sea.database.values["NAV_SPEED"]
            await sea.steps(20)
            return sea.app.session._node.counts["surge"]

    counts = asyncio.run(work())
    assert counts["wrong_type"] == 3 and counts["empty"] == 2
    assert counts["not_a_number"] == 3 and counts["no_time"] == 4  # the stamp 1e308 is no time that can be aligned
    assert counts["out_of_range"] == 3


def test_an_old_last_value_is_no_news_but_a_held_command_is(tmp_path):
    async def work():
        database, old = Moosdb(), time.time() - 5000
        for part, name in NAMES.items():
            database.post(name, 10.0, at=old, source="pNav" if part == "surge" else "boat")
        async with at_sea(prior(tmp_path), database) as sea:
            await ready(sea)
            await until(lambda: "heading" in sea.app.session._node.counts)
            await asyncio.sleep(0.1)
            assert set(sea.app.session._node.counts["heading"]) == {"last_value"}
            assert set(sea.app.session._listening.heard) == {"command_left", "command_right"}
            await sea.steps(20, leave_out="command_left")
            assert sea.app.session._node.counts["surge"]["last_value"] in (1, 2)  # also while it starts

    asyncio.run(work())


def test_a_database_that_knows_a_name_with_another_type(tmp_path):
    async def work():
        database = Moosdb()
        database.post("USV_SPEED_PRED", "none")
        async with at_sea(prior(tmp_path), database) as sea:
            await ready(sea)
            await sea.steps(20)
            assert {each.key for each in database.refused} == {"USV_SPEED_PRED"}

    asyncio.run(work())


def test_one_app_of_several_that_post_a_variable(tmp_path):
    async def work():
        async with at_sea(prior(tmp_path, channels={"surge": {"name": "NAV_SPEED@pNav"}})) as sea:
            await ready(sea)
            sea.sail(5)
            await asyncio.sleep(0.2)
            assert "surge" not in sea.app.session._listening.heard
            sea.database.post("NAV_SPEED", 1.0, "pNav")
            await until(lambda: "surge" in sea.app.session._listening.heard)

    asyncio.run(work())


def test_a_plain_community_is_told_what_to_name(tmp_path):
    """pMarinePID posts DESIRED_THRUST and DESIRED_RUDDER, never a command of a side."""

    async def work():
        async with at_sea(prior(tmp_path)) as sea:
            await ready(sea)
            sea.database.post("DESIRED_THRUST", 40.0)
            sea.database.post("DESIRED_RUDDER", 5.0)
            await until(lambda: "warnings=1" in str(sea.posted("USV_HEALTH")[-1:]))
            sea.database.post("APPCAST_REQ", ASK)
            await until(lambda: "add `throttle = DESIRED_THRUST`" in str([each.text for each in sea.posted("APPCAST")]))
            await sea.steps(10)  # it has commands of both sides after all
            await until(lambda: "warnings=0" in str(sea.posted("USV_HEALTH")[-1:]))

    asyncio.run(work())


def test_one_command_for_both_sides_is_learned_and_its_limits_are_told(tmp_path, capsys):
    channels = {"throttle": {"name": "DESIRED_THRUST"}}

    async def work():
        async with at_sea(prior(tmp_path, channels=channels)) as sea:
            await ready(sea)
            for part, stamp, value in messages(boat(), sea.began):
                if stamp > sea.began + 60:
                    break
                if part != "command_right" and part in NAMES:
                    name = "DESIRED_THRUST" if part == "command_left" else NAMES[part]
                    sea.database.post(name, SCALE[part] * value, at=stamp)
            await until(lambda: len(sea.posted("USV_SPEED_NEXT")) > 100)
            sea.database.post("APPCAST_REQ", ASK)
            await until(lambda: "one command drives both" in str([each.text for each in sea.posted("APPCAST")[-1:]]))
            await until(lambda: sea.app.session._identified)
            return sea

    sea = asyncio.run(work())
    page = sea.posted("APPCAST")[-1].text
    assert "nothing tells left from right" in page.replace("!@            ", " ") and "thrust ratio" not in page
    assert not any(name.endswith(("left", "right", "ratio")) for name in sea.app.session._identified)
    assert "_left" not in str([each.text for each in sea.posted("USV_PARAMS")])
    assert "note: one command drives both sides" in capsys.readouterr().out
    assert "Note        one command drives both sides" in "\n".join(status_lines(tmp_path))


def test_a_plan_that_is_posted_is_answered(tmp_path):
    async def work():
        database = Moosdb()
        database.post("USVLEARN_PLAN", "0,1,1", at=time.time() - 1000)  # of yesterday
        async with at_sea(prior(tmp_path), database) as sea:
            await until(lambda: sea.app.client.connected)
            database.post("USVLEARN_PLAN", '{"id": 1, "t": [0], "left": [1], "right": [1]}')
            await ready(sea)
            await sea.steps(60)
            node = sea.app.session._node
            for text in ("0,0.5,0.5; 5,1,1", "0,50,50", '{"id": 2, "t": [0], "left": [1], "right": [1]}'):
                before = len(sea.posted("USV_PLAN_FORECAST"))
                database.post("USVLEARN_PLAN", text)
                await until(lambda before=before: len(sea.posted("USV_PLAN_FORECAST")) > before)
            *early, rows, error, last = [each.text for each in sea.posted("USV_PLAN_FORECAST")]
            assert all("no forecast can be made" in each for each in early) and len(early) <= 1
            assert rows.startswith("0.4=") and rows.count(",") == 74
            assert error.startswith("error: plan: found left 50 in row 1")
            assert json.loads(last)["id"] == 2 and len(json.loads(last)["surge"]) == 75
            assert node.counts["plan"]["refused"] in (1, 1 + len(early))  # an early one came before the node or to it
            assert not database.refused

    asyncio.run(work())


def test_a_pattern_is_no_variable(tmp_path):
    options = prior(tmp_path, channels={"surge": {"name": "*SPEED"}})
    settings = Settings("pUSVLearn", "127.0.0.1", 1, 1.0, "", 4.0, "USV_", False, options)
    for _ in range(2):  # the folder is free again
        with pytest.raises(ConfigError, match=r"surge: found '\*SPEED', expected the name of one variable"):
            run(Session(options, MIDDLEWARE), settings)


def test_faults_of_the_database_do_not_stop_it(tmp_path, monkeypatch):
    monkeypatch.setattr(link, "FIRST", 0.02)
    monkeypatch.setattr(link, "SILENCE", 2.0)

    async def work():
        async with at_sea(prior(tmp_path)) as sea:
            database, client = sea.database, sea.app.client
            await ready(sea)
            await sea.steps()
            for fault in ("killed", "restarted", "frozen", "garbage", "cut"):
                count = client.counts["connected"]
                if fault in ("killed", "restarted"):
                    database.kill()
                    await asyncio.sleep(0.3 if fault == "killed" else 0.0)
                    await database.start()
                elif fault == "frozen":
                    database.freeze()
                    await until(lambda: client.counts["silent"])
                    database.thaw()
                elif fault == "garbage":
                    database.inject(b"\xff" * 99)
                else:
                    database.inject(wire.encode([Message("N", "NAV_SPEED", value=1.0)])[:30])
                    database.links["pUSVLearn"].writer.close()
                await until(lambda count=count: client.counts["connected"] > count and database.links)
                await asyncio.sleep(0.05)
                await sea.steps()
            database.post("APPCAST_REQ", ASK)
            await until(lambda: "garbage 1" in str([each.text for each in sea.posted("APPCAST")[-1:]]))
            assert not client.counts["outbox"]

    asyncio.run(work())


def test_clocks_that_jump_by_an_hour(tmp_path):
    async def work():
        async with at_sea(prior(tmp_path)) as sea:
            await ready(sea)
            for shift in (0.0, 3600.0, 0.0, -3600.0, 0.0):
                await sea.steps(20, shift=shift)

    asyncio.run(work())


def test_a_full_disk_is_a_warning(tmp_path, monkeypatch):
    def full(self, *_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    async def work():
        async with at_sea(prior(tmp_path, save_period=0.1)) as sea:
            await ready(sea)
            monkeypatch.setattr(NodeFolder, "save", full)
            await sea.steps(20)
            sea.database.post("APPCAST_REQ", ASK)
            await until(lambda: "run_warnings=1:no checkpoint can be saved" in str(sea.posted("APPCAST")[-1:]))
            await sea.steps(20)

    asyncio.run(work())


def test_warped_time(tmp_path):
    async def work():
        database = Moosdb(warp=10.0)
        async with at_sea(prior(tmp_path, warp=10.0), database) as sea:
            await ready(sea)
            await sea.steps(30)
            assert abs(sea.posted("USV_SPEED_PRED")[-1].time - 10 * time.time()) < 100
            gaps = [each.value for each in sea.posted("PUSVLEARN_ITER_GAP")]
            assert 0.5 < sorted(gaps)[len(gaps) // 2] < 5.0

    asyncio.run(work())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_leaves(tmp_path, number):
    database = Moosdb()
    with database.in_thread() as call:
        mission = tmp_path / "a.moos"
        lines = [f"ServerPort = {database.port}", "Community = usv", "ProcessConfig = pLearn", "{", "mass = 36",
                 "surge_max = 3", f"folder = {tmp_path}/node", "}"]  # fmt: skip
        mission.write_text("\n".join(lines))
        command = [sys.executable, "-m", "usvlearn", "live", "moos", str(mission), "pLearn"]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)

        def states() -> list[str]:
            return [each.text for each in database.posted if each.key == "USV_HEALTH"]

        end = time.monotonic() + 300
        while not any("state=waiting" in each for each in states()):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        rows = messages(boat(), time.time())
        for part, stamp, value in rows:
            if stamp > time.time() + 20:
                break
            if part in NAMES:
                call(database.post, NAMES[part], SCALE[part] * value, at=stamp)
        time.sleep(0.3)
        process.send_signal(number)
        said, _ = process.communicate(timeout=60)
        call(asyncio.sleep, 0.1)
    assert process.returncode == 0, said
    assert [each.text for each in database.posted if each.key == "EXITED_NORMALLY"] == ["pLearn"]
    assert "starting from the prior" in said and "saved; ends" in said
    assert len(list((tmp_path / "node").glob("live_*.safetensors"))) == 1
