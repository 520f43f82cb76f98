"""Another implementation of the protocol as second opinion: pymoos2 reads what we write, and we what it writes."""

import asyncio
import struct

import numpy as np
import pytest

from tests.support.moosdb import Moosdb
from usvlearn.live.moos import wire
from usvlearn.live.moos.client import Client
from usvlearn.live.moos.wire import Message

reason = "needs the package pymoos2"
theirs = pytest.importorskip("pymoos2.core.MOOSMsg", reason=reason).MOOSMsg
packets = pytest.importorskip("pymoos2.core.MOOSCommPkt", reason=reason)
pymoos2 = pytest.importorskip("pymoos2", reason=reason)


def test_their_packets_are_ours():
    rng = np.random.default_rng(0)
    for _ in range(300):
        texts = ["".join(chr(each) for each in rng.integers(32, 900, rng.integers(0, 9))) for _ in range(5)]
        number = struct.unpack("<d", rng.bytes(8))[0]
        number = number if number == number else 1.0
        ours = [
            Message("N", "K" + texts[0], "D", number, "", float(k), *texts[1:4], 2.0, int(rng.integers(-2, 99)))
            if rng.random() < 0.5
            else Message("R", texts[0], "S", number, "S" + texts[4], float(k), *texts[1:4], 2.0, 3)
            for k in range(rng.integers(1, 5))
        ]
        read = packets.unpack(wire.encode(ours))
        for mine, other in zip(ours, read, strict=True):
            assert (chr(other.msg_type), other.key, chr(other.data_type), other.val, other.sval, other.time) == mine[:6]
            assert (other.src, other.src_aux, other.community, other.val2, other.msg_id) == mine[6:]
        assert wire.decode(packets.pack(read)) == ours


def test_it_talks_to_the_client_through_the_stand_in():
    async def work():
        database, received = Moosdb(), []
        await database.start()
        client = Client("pUSVLearn", "127.0.0.1", database.port, received.append)
        client.register("NAV_SPEED")
        task = asyncio.create_task(client.run())
        boat = pymoos2.MOOSCommClient("127.0.0.1", database.port, "boat", comm_tick=50.0)
        boat.register("USV_SPEED_PRED")
        boat.register("USV_ALARM")
        boat.start()
        posts, fetched = 0, []
        end = asyncio.get_running_loop().time() + 20
        while (len(received) < 20 or len(fetched) < 2) and asyncio.get_running_loop().time() < end:
            if boat.is_connected:
                boat.notify("NAV_SPEED", float(posts), time_val=1e9 + posts)
                posts += 1
            if posts == 5:
                client.notify("USV_SPEED_PRED", 1.25)
                client.notify("USV_ALARM", "the left thruster")
            fetched += boat.fetch()
            await asyncio.sleep(0.01)
        await asyncio.to_thread(boat.stop)
        task.cancel()
        database.kill()
        await asyncio.sleep(0.05)
        return received, {each.key: each for each in fetched}

    received, fetched = asyncio.run(work())
    assert [(each.value, each.time, each.source) for each in received] == [
        (float(k), 1e9 + k, "boat") for k in range(len(received))
    ]
    assert len(received) >= 20
    assert fetched["USV_SPEED_PRED"].is_double() and fetched["USV_SPEED_PRED"].double() == 1.25
    assert fetched["USV_ALARM"].is_string() and fetched["USV_ALARM"].string() == "the left thruster"
    assert fetched["USV_ALARM"].source() == "pUSVLearn"
