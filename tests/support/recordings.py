"""Logs of a boat that speeds up evenly, as channels and as recordings."""

import math

import numpy as np

from usvlearn.logs.channels.channel import Channel, Recording


def channel(time, value, order=None, **how) -> Channel:
    time = np.asarray(time, dtype=np.float64)
    value = np.broadcast_to(np.asarray(value, dtype=np.float64), time.shape)
    return Channel(time, value, np.arange(len(time)) if order is None else np.asarray(order), **how)


def log(seconds: float = 4.0, hz: float = 10.0, **changes) -> dict[str, Channel]:
    """Four channels at one rate, interleaved by time; speed rises by 0.1 m/s a second, the boat turns at 0.2 rad/s."""
    time = np.arange(round(seconds * hz) + 1) / hz
    channels = {
        "command_left": channel(time, 0.5),
        "command_right": channel(time, 0.4),
        "heading": channel(time, 0.2 * time % (2 * math.pi)),
        "surge": channel(time, 0.1 * time),
    }
    channels |= changes
    return in_order(channels)


def in_order(channels):
    """Give messages the order of their stamps, inputs before the speed of the same stamp."""
    stamps = np.concatenate([c.time for c in channels.values()])
    rank = np.empty(len(stamps), dtype=np.int64)
    rank[np.argsort(stamps, kind="stable")] = np.arange(len(stamps))
    pieces = np.split(rank, np.cumsum([len(c.time) for c in channels.values()])[:-1])
    return {name: c._replace(order=r) for (name, c), r in zip(channels.items(), pieces, strict=True)}


def recording(boat, run, seconds, speed=0.1):
    channels = log(seconds)
    surge = channels["surge"]
    return Recording(
        boat, run, {**channels, "surge": surge._replace(value=speed + surge.value)}, {"surge": {"empty": 2}}
    )


def same(x, y):
    """Whether two lists of recordings hold the same bits."""
    return [(r.boat, r.run, r.dropped) for r in x] == [(r.boat, r.run, r.dropped) for r in y] and all(
        np.array_equal(p, q)
        for r, s in zip(x, y, strict=True)
        for name in r.channels
        for p, q in zip(r.channels[name][:3], s.channels[name][:3], strict=True)
    )
