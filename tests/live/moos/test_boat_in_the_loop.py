"""A simulated boat sails over a MOOSDB while the node learns: it publishes what a replay of its record gives."""

import asyncio
import contextlib
import math
import time

import numpy as np
import pytest

from tests.support.live import boat, messages, replayed
from usvlearn.live.moos.app import App
from usvlearn.live.moos.block import MIDDLEWARE, Settings
from usvlearn.live.moos.client import Client
from usvlearn.live.session import Session
from usvlearn.live.start import Options

WARP = 20.0
VARIABLES = {"command_left": ("DESIRED_THRUST_L", 100.0), "command_right": ("DESIRED_THRUST_R", 100.0),
             "heading": ("NAV_HEADING", 180 / math.pi), "surge": ("NAV_SPEED", 1.0)}  # fmt: skip


async def sail(client: Client, seconds: float) -> None:
    """Post what the boat says, as time goes by; `seconds` of its time."""
    began = time.monotonic()
    for part, stamp, value in messages(boat(), 0.0):
        if stamp > seconds:
            return
        await asyncio.sleep(max(began + stamp / WARP - time.monotonic(), 0.0))
        if part in VARIABLES:
            name, scale = VARIABLES[part]
            client.notify(name, scale * value)


async def voyage(database, folder, start, kills: int, seconds: float) -> dict[str, list[float]]:
    """Sail `seconds` before, between and after the kills of the database; returns what came of the app's posts."""
    database.warp = WARP
    await database.start()
    options = Options(folder, start, record=True, warp=WARP)
    settings = Settings("pUSVLearn", "127.0.0.1", database.port, WARP, "usv", 4.0, "USV_", False, options)
    app = App(Session(options, MIDDLEWARE), settings)
    values: dict[str, list[float]] = {"USV_SPEED_PRED": [], "USV_SPEED_ERROR": []}
    sailor = Client("boat", "127.0.0.1", database.port, print, WARP)
    viewer = Client("viewer", "127.0.0.1", database.port, lambda each: values[each.key].append(each.value), WARP)
    for name in values:
        viewer.register(name)
    others = [asyncio.create_task(each.run()) for each in (sailor, viewer)]
    task = asyncio.create_task(app.main())
    try:
        while app.session.state == "compiling":
            assert not task.done()
            await asyncio.sleep(0.05)
        for kill in range(kills + 1):
            for each in (app.client, viewer, sailor):
                while not each.connected:
                    await asyncio.sleep(0.01)
            await sail(sailor, seconds)
            await asyncio.sleep(0.3)
            if kill < kills:
                database.kill()
                await asyncio.sleep(0.5)
                await database.start()
    finally:
        app.stop()
        await task
        await asyncio.sleep(0.2)
        for each in others:
            each.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*others)
        database.kill()
        await asyncio.sleep(0.05)
    return values


@pytest.mark.thorough
@pytest.mark.parametrize(("kills", "seconds"), [(0, 60.0), pytest.param(1, 40.0, marks=pytest.mark.slow)])
def test_what_is_published_is_what_a_replay_gives(database, tmp_path, start, kills, seconds):
    values = asyncio.run(voyage(database, tmp_path, start, kills, seconds))
    again = replayed(tmp_path / "records")[:, -1]
    again = again[np.isfinite(again)]
    published = np.array(values["USV_SPEED_PRED"])
    assert len(published) > 0.6 * (kills + 1) * seconds / 0.4
    if not kills:
        np.testing.assert_array_equal(published, again[: len(published)])
        assert len(again) - len(published) <= 2  # the last steps, which are made at the end, are not published
    else:  # a post that was in flight is lost; all others are the same
        assert len(published) > 0.9 * len(again) and set(published) <= set(again)
    assert np.abs(values["USV_SPEED_ERROR"]).mean() < 0.2
