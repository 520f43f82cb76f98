"""The app at the stand-in: what it publishes and answers, how it ends, and what faults of messages and links do."""

import asyncio
import json
import math
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from tests.support import ROOT, few
from tests.support.live import NotedSession, boat, messages, planar_set
from tests.support.moos_app import ASK, NAMES, SCALE, at_sea, awaited, prior, ready, until
from tests.support.moosdb import Moosdb
from usvlearn.errors import ConfigError
from usvlearn.live.moos import client as link
from usvlearn.live.moos import wire
from usvlearn.live.moos.app import KEYS, App, AppCasts, run
from usvlearn.live.moos.block import ANSWER, MIDDLEWARE, Settings, interface
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.live.start import Options
from usvlearn.live.status import TABLE, status_lines


def test_a_variable_answers_an_alarm():
    """But not with what the database had at the subscription."""
    app = object.__new__(App)
    app.session, app.settings, app._busy = NotedSession(), SimpleNamespace(plan="USVLEARN_PLAN"), 0.0
    for old in (True, False):
        app._is_last_value = lambda _, old=old: old
        app.take(Message("N", ANSWER, wire.TEXT, text="reset"))
    assert app.session.answers == ["reset"] and f"  {ANSWER} " in interface()


@pytest.mark.thorough
@awaited
async def test_it_publishes_what_the_node_says(tmp_path):
    async with at_sea(prior(tmp_path / "moos")) as sea:
        await ready(sea)
        before = sea.database.now()
        await sea.steps(60)
        await until(lambda: sea.posted("USV_PARAMS") and sea.posted("PUSVLEARN_STATUS"))
    kinds = {"USV_" + each.name: each.kind for each in TABLE}
    mine = [each for each in sea.database.posted if each.source == "pUSVLearn"]
    assert not sea.database.refused
    assert all(each.data == kinds[each.key] for each in mine if each.key in kinds)
    assert all(before - 60 < each.time < time.time() for each in mine)
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


@pytest.mark.thorough
@awaited
async def test_while_code_compiles_it_answers_and_then_asks_again(tmp_path, monkeypatch):
    compiled = threading.Event()
    make = Session._make
    monkeypatch.setattr(Session, "_make", lambda self: compiled.wait() and make(self))
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


@pytest.mark.thorough
@awaited
async def test_an_old_last_value_is_no_news_but_a_held_command_is(tmp_path):
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


@awaited
async def test_one_app_of_several_that_post_a_variable(tmp_path):
    async with at_sea(prior(tmp_path, channels={"surge": {"name": "NAV_SPEED@pNav"}})) as sea:
        await ready(sea)
        sea.sail(5)
        await asyncio.sleep(0.2)
        assert "surge" not in sea.app.session._listening.heard
        sea.database.post("NAV_SPEED", 1.0, "pNav")
        await until(lambda: "surge" in sea.app.session._listening.heard)


@pytest.mark.thorough
@awaited
async def test_a_plain_community_is_told_what_to_name(tmp_path):
    """pMarinePID posts DESIRED_THRUST and DESIRED_RUDDER, never a command of a side."""
    async with at_sea(prior(tmp_path)) as sea:
        await ready(sea)
        sea.database.post("DESIRED_THRUST", 40.0)
        sea.database.post("DESIRED_RUDDER", 5.0)
        await until(lambda: "warnings=1" in str(sea.posted("USV_HEALTH")[-1:]))
        sea.database.post("APPCAST_REQ", ASK)
        await until(lambda: "add `throttle = DESIRED_THRUST`" in str([each.text for each in sea.posted("APPCAST")]))
        await sea.steps(10)  # it has commands of both sides after all
        await until(lambda: "warnings=0" in str(sea.posted("USV_HEALTH")[-1:]))


@pytest.mark.thorough
@awaited
async def test_one_command_for_both_sides_is_learned_and_its_limits_are_told(tmp_path, capsys):
    channels = {"throttle": {"name": "DESIRED_THRUST"}}
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
    page = sea.posted("APPCAST")[-1].text
    assert "nothing tells left from right" in page.replace("!@            ", " ") and "thrust ratio" not in page
    assert not any(name.endswith(("left", "right", "ratio")) for name in sea.app.session._identified)
    assert "_left" not in str([each.text for each in sea.posted("USV_PARAMS")])
    assert "note: one command drives both sides" in capsys.readouterr().out
    assert "Note        one command drives both sides" in "\n".join(status_lines(tmp_path))


@pytest.mark.thorough
@awaited
async def test_a_plan_that_is_posted_is_answered(tmp_path):
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


@pytest.mark.thorough
@awaited
async def test_warped_time(tmp_path):
    database = Moosdb(warp=10.0)
    async with at_sea(prior(tmp_path, warp=10.0), database) as sea:
        await ready(sea)
        await sea.steps(30)
        assert abs(sea.posted("USV_SPEED_PRED")[-1].time - 10 * time.time()) < 100
        gaps = [each.value for each in sea.posted("PUSVLEARN_ITER_GAP")]
        assert 0.5 < sorted(gaps)[len(gaps) // 2] < 5.0


@pytest.mark.thorough
@pytest.mark.parametrize("number", few([signal.SIGTERM, signal.SIGINT], [signal.SIGTERM]))
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


@pytest.mark.thorough
@awaited
async def test_a_node_that_makes_tracks_posts_them_and_answers_a_plan_by_one(tmp_path):
    """It subscribes to positions, and does not wait for them."""
    async with at_sea(Options(tmp_path / "node", planar_set(tmp_path / "run", reader=None))) as sea:
        await ready(sea)
        await sea.steps(20)
        await until(lambda: sea.posted("USV_TRACK"))
        sea.database.post("USVLEARN_PLAN", '{"id": 5, "t": [0], "left": [0.4], "right": [0.4]}')
        await until(lambda: sea.posted("USV_PLAN_FORECAST"))
    assert {"NAV_X", "NAV_Y"} <= set(sea.app.client.registered)
    rows = [dict(row.split("=") for row in each.text.split(",")) for each in sea.posted("USV_TRACK")]
    assert len(rows) > 20 and all(list(row) == ["2", "5.2", "10", "30"] for row in rows)
    north, east = map(float, rows[-1]["10"].split(":")[:2])
    assert 1.0 < math.hypot(north, east) < 30.0
    answer = json.loads(sea.posted("USV_PLAN_FORECAST")[0].text)
    assert answer["id"] == 5 and len(answer["north"]) == 75 and answer["t"][-1] == 30.0


def taken_apart(text: str) -> dict[str, list[str]]:
    """Field -> items: pairs between `!@#`, cut at the first `=`, and items between `!@`."""
    pairs = (pair.partition("=") for pair in text.split("!@#") if pair)
    return {key: [item for item in value.split("!@") if item] for key, _, value in pairs}


def test_a_viewer_finds_each_field():
    casts = AppCasts("pUSVLearn")
    casts.event("connected", 12.345)
    casts.warn("the disk is full, now=1")
    casts.warn("the disk is full, now=1")
    casts.config_warnings = ["set 3 is damaged"]
    fields = taken_apart(casts.compose(7, "usv", ["State  ok", "", "a!@b", "=x"]))
    assert fields == {
        "proc": ["pUSVLearn"],
        "iter": ["7"],
        "node": ["usv"],
        "messages": ["State  ok", "a! @b", "=x"],
        "config_warnings": ["set 3 is damaged"],
        "events_total": ["1"],
        "events": ["[12.35]: connected"],
        "run_warning_total": ["2"],
        "run_warnings": ["2:the disk is full, now=1"],
    }
    empty = AppCasts("pUSVLearn").compose(1, "usv", [])
    assert empty.count("!@#") == 8 and "run_warnings" not in empty


def due(*requests: str, at: float = 1.0, casts: AppCasts | None = None) -> bool:
    casts = casts or AppCasts("pUSVLearn")
    for request in requests:
        casts.ask(request, 0.0, "usv")
    return casts.due(at)


def test_only_requests_for_this_app_count():
    whole = "node=usv,app=pUSVLearn,duration=3.0,key=uMAC_1,thresh=any"
    assert due(whole) and due(whole, at=3.0) and not due(whole, at=3.1)
    assert due("node=all, app=all, duration=3, key=k, thresh=any")
    assert not due()
    assert not due(whole.replace("usv", "other", 1)) and not due(whole.replace("pUSVLearn", "pOther"))
    for nonsense in ("", "=", "node", "duration=3", whole.replace("3.0", "nan"), whole.replace("3.0", "soon")):
        assert not due(nonsense)
    assert not due(whole.replace("3.0", "1e9"), at=31.0)


def test_each_key_has_its_own_end():
    long, short = "node=usv,app=all,duration=20,key=a,thresh=any", "node=usv,app=all,duration=1,key=b,thresh=any"
    assert due(long, short, at=10.0) and not due(long, short.replace("key=b", "key=a"), at=10.0)
    casts = AppCasts("pUSVLearn")
    for k in range(10 * KEYS):
        casts.ask(f"node=usv,app=all,duration=20,key={k}", 0.0, "usv")
    assert len(casts._asked) == KEYS


def test_a_viewer_may_wait_for_warnings():
    casts = AppCasts("pUSVLearn")
    assert not due("node=usv,app=all,duration=20,key=a,thresh=run_warning", casts=casts)
    casts.warn("trouble")
    assert casts.due(2.0) and not casts.due(3.0)
    casts.warn("trouble")
    assert casts.due(4.0)
    for k in range(10 * KEYS):
        casts.warn(f"{k}")
    assert len(casts.warnings) == KEYS and f"{10 * KEYS - 1}" in casts.warnings


@pytest.mark.thorough
@awaited
async def test_messages_that_are_no_numbers(tmp_path):
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
        counts = sea.app.session._node.counts["surge"]
    assert counts["wrong_type"] == 3 and counts["empty"] == 2
    assert counts["not_a_number"] == 3 and counts["no_time"] == 4  # the stamp 1e308 is no time that can be aligned
    assert counts["out_of_range"] == 3


@pytest.mark.thorough
@awaited
async def test_a_database_that_knows_a_name_with_another_type(tmp_path):
    database = Moosdb()
    database.post("USV_SPEED_PRED", "none")
    async with at_sea(prior(tmp_path), database) as sea:
        await ready(sea)
        await sea.steps(20)
        assert {each.key for each in database.refused} == {"USV_SPEED_PRED"}


def test_a_pattern_is_no_variable(tmp_path):
    options = prior(tmp_path, channels={"surge": {"name": "*SPEED"}})
    settings = Settings("pUSVLearn", "127.0.0.1", 1, 1.0, "", 4.0, "USV_", False, options)
    for _ in range(2):  # the folder is free again
        with pytest.raises(ConfigError, match=r"surge: found '\*SPEED', expected the name of one variable"):
            run(Session(options, MIDDLEWARE), settings)


@pytest.mark.thorough
@awaited
async def test_faults_of_the_database_do_not_stop_it(tmp_path, monkeypatch):
    monkeypatch.setattr(link, "FIRST", 0.02)
    async with at_sea(prior(tmp_path)) as sea:
        database, client = sea.database, sea.app.client
        await ready(sea)
        await sea.steps()
        for fault in ("restarted", "cut"):  # others: `test_client.py`
            count = client.counts["connected"]
            if fault == "restarted":
                database.kill()
                await database.start()
            else:
                database.inject(wire.encode([Message("N", "NAV_SPEED", value=1.0)])[:30])
                database.links["pUSVLearn"].writer.close()
            await until(lambda count=count: client.counts["connected"] > count and database.links)
            await asyncio.sleep(0.05)
            await sea.steps()
        database.post("APPCAST_REQ", ASK)
        await until(lambda: "lost 2" in str([each.text for each in sea.posted("APPCAST")[-1:]]))
        assert not client.counts["outbox"]
