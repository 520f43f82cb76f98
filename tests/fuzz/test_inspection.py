"""Damaged logs: `usvlearn inspect` proposes something, or refuses them in one sentence."""

import numpy as np
import pytest

from tests.support.shapes import SHAPES
from tests.support.voyages import voyage
from usvlearn.errors import UsvlearnError
from usvlearn.logs.inspection.inspected import inspect_logs


def mutated(rng: np.random.Generator, whole: bytes) -> bytes:
    """Bytes changed, removed or added; lines in another order; the rest cut off."""
    data, at = bytearray(whole), int(rng.integers(len(whole)))
    match int(rng.integers(5)):
        case 0:
            return bytes(data[:at])
        case 1:
            for place in rng.integers(len(data), size=100):
                data[place] = rng.integers(256)
        case 2:
            del data[at : at + int(rng.integers(1, 5000))]
        case 3:
            data[at:at] = rng.bytes(1000)
        case 4:
            lines = whole.splitlines(keepends=True)
            return b"".join([lines[0], *(lines[k] for k in 1 + rng.permutation(len(lines) - 1))])
    return bytes(data)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.fuzz(cases=8, slow=500)
@pytest.mark.parametrize("name", ["pwm", "moos", "german", "nameless", "velocities"])
def test_a_damaged_log_is_inspected_or_refused(tmp_path, rng, cases, name):
    log = SHAPES[name].write(tmp_path, voyage(0, minutes=1.5))
    whole = log.read_bytes()
    inspected = 0
    for _ in range(cases):
        log.write_bytes(mutated(rng, whole))
        try:
            inspect_logs([str(log)])
            inspected += 1
        except UsvlearnError as error:
            assert "\n" not in str(error)
    assert inspected > 0
