"""The app of MOOS beside the stand-in for a database, and a boat that posts there."""

import asyncio
import contextlib
import functools
import math
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any

from tests.support.live import boat, messages
from tests.support.moosdb import Moosdb
from usvlearn.live.moos.app import App
from usvlearn.live.moos.block import MIDDLEWARE, Settings
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.live.start import Options

NAMES = {"command_left": "DESIRED_THRUST_L", "command_right": "DESIRED_THRUST_R",
         "heading": "NAV_HEADING", "surge": "NAV_SPEED"}  # fmt: skip
SCALE = {"command_left": 100.0, "command_right": 100.0, "heading": 180 / math.pi, "surge": 1.0}
ASK = "node=usv,app=pUSVLearn,duration=30,key=test,thresh=any"


async def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not come true"
        await asyncio.sleep(0.005)


def awaited(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """A test that is a coroutine, run in a loop of its own."""

    @functools.wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(test(**fixtures))

    return run


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
