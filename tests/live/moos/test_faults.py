"""Faults of messages, of the database, of clocks and of the disk: none stops the app."""

import asyncio
import math

import pytest

from tests.support.moos_app import ASK, at_sea, awaited, prior, ready, until
from tests.support.moosdb import Moosdb
from usvlearn.errors import ConfigError
from usvlearn.live.moos import client as link
from usvlearn.live.moos import wire
from usvlearn.live.moos.app import run
from usvlearn.live.moos.block import MIDDLEWARE, Settings
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session


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
