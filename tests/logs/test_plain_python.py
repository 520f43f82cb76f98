"""The kernels of logs as plain Python, as a debugger sees them, give the same bits as compiled code."""

import json

import numpy as np
import pytest

from tests.support.ardupilot import dataflash, tlog
from tests.support.commands import python
from usvlearn.logs.alignment.align import Aligner
from usvlearn.logs.channels.channel import CHANNELS, Source
from usvlearn.logs.formats.ardupilot import binary_kernel
from usvlearn.logs.formats.ardupilot.dataflash import LETTERS
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES

HELD = {name: Source(name, held=name.startswith("command"), delay=0.1 * (name != "surge")) for name in CHANNELS}
SLOPES = {name: Source(name, window=1.5) for name in CHANNELS if name != "yaw_rate"}
OPTIONS = {  # how the log below is aligned
    "default": ({name: Source(name) for name in CHANNELS}, {}),
    "held and late": (HELD, {"inputs": "last", "patience": 0.3}),
    "slope of the heading": (SLOPES, {"inputs": "next", "outage": 2.0}),
    "at each speed": (SLOPES, {"steps": "speed"}),
}


def aligned() -> dict:
    """All that comes of a log with jitter, gaps, repeated stamps, impossible values, and a clock that is set back."""
    rng, count, results = np.random.default_rng(1), 1500, {}
    stamps = np.cumsum(rng.exponential(0.03, count)) + rng.normal(0, 0.05, count)
    stamps[500:], stamps[900:], stamps[1200:] = stamps[500:] + 3, stamps[900:] + 40, stamps[1200:] - 70
    stamps[rng.integers(0, count, 20)] = 1e9
    again = rng.integers(1, count, 40)
    stamps[again] = stamps[again - 1]
    places, values = rng.integers(0, len(CHANNELS), count), rng.uniform(-0.2, 1.25, count)
    values[rng.integers(0, count, 20)] = np.nan
    for name, (sources, options) in OPTIONS.items():
        aligner, rows = Aligner(sources, **options), []
        for part in np.array_split(np.flatnonzero(np.isin(places, [CHANNELS.index(each) for each in sources])), 15):
            aligner._make_room(len(part))
            rows += aligner.feed(places[part], stamps[part], values[part]).tolist()
        rows += aligner.feed(places[:0], stamps[:0], values[:0], flush=True).tolist()
        results[name] = [rows, np.array(aligner.ahead(9)).tolist(), aligner.windows, aligner.rejected]
    return results


def scanned() -> list:
    """What the readers of binary logs find in one of each kind, with damage in the middle."""
    extras, sizes = np.full(binary_kernel.IDS, -1, dtype=np.int16), np.zeros(256, dtype=np.int64)
    for number, message in MESSAGES.items():
        extras[number] = message.extra
    for letter, (kind, _) in LETTERS.items():
        sizes[ord(letter)] = np.dtype(kind).itemsize
    frames, messages = (
        np.frombuffer(content[:3000] + b"\xfe\xff\xa3\x95" * 9 + content[3100:], np.uint8)
        for content in (tlog(20), dataflash(20))
    )
    starts, lengths, *others = binary_kernel.scan_tlog(frames, extras)
    ends = binary_kernel.gather(frames, starts, lengths, 9, 40)  # some payloads end before
    return [each.tolist() for each in (starts, lengths, *others, ends, *binary_kernel.scan_dataflash(messages, sizes))]


@pytest.mark.thorough
def test_plain_python_reads_and_aligns_as_compiled_code_does():
    code = f"import json; from {__name__} import aligned, scanned; print(json.dumps([aligned(), scanned()]))"
    plain, compiled = python(code, NUMBA_DISABLE_JIT="1").stdout, [aligned(), scanned()]
    assert plain == json.dumps(compiled) + "\n"
    for rows, _, _, rejected in compiled[0].values():
        assert sum(row[7] for row in rows) > 20 and sum(map(len, rejected.values())) > 15
    assert len(compiled[1][0]) > 50
