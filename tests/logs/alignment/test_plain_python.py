"""The kernels of the alignment as plain Python, as a debugger sees them: they make the same steps as compiled code."""

import json

import numpy as np

from tests.support.commands import python
from usvlearn.logs.alignment.align import Aligner
from usvlearn.logs.channels.channel import CHANNELS, Source

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
    rng, count, found = np.random.default_rng(1), 1500, {}
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
        found[name] = [rows, np.array(aligner.ahead(9)).tolist(), aligner.windows, aligner.rejected]
    return found


def test_plain_python_aligns_as_compiled_code_does():
    code = f"import json; from {__name__} import aligned; print(json.dumps(aligned()))"
    plain, compiled = python(code, NUMBA_DISABLE_JIT="1").stdout, aligned()
    assert plain == json.dumps(compiled) + "\n"  # bit for bit
    for rows, _, _, rejected in compiled.values():
        assert sum(row[7] for row in rows) > 20 and sum(map(len, rejected.values())) > 15
