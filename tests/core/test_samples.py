"""Which steps are made, learned from and scored: decided alike for NumPy, for torch and in compiled code."""

import itertools

import numpy as np
import pytest
import torch

from usvlearn import Inputs, Sample
from usvlearn.core.prepared_samples import HOLD, LEARN, MODE, PREDICT, ROW, START, SURGE, prepare_all
from usvlearn.core.protocol import clean
from usvlearn.core.samples import PLAUSIBLE_INPUTS, masks, tree_map

LIMIT = 10.0
SPEEDS = [0.0, -3.0, 1e6, np.nan, np.inf, -np.inf, LIMIT, -LIMIT, np.nextafter(np.float32(LIMIT), np.float32(0.0))]


def edges(dtype) -> Sample:
    """Every field at, below and beyond its limit, `(time, 1)`, with each kind of flags."""
    plain = Inputs(0.5, 0.5, 1.0, 0.1, 0.4)
    changed = [plain]
    for name, limit in PLAUSIBLE_INPUTS._asdict().items():
        below = float(np.nextafter(np.float32(limit), np.float32(0.0)))
        for value in (limit, -limit, below, -below, np.nan, np.inf, -np.inf, 0.0):
            changed.append(plain._replace(**{name: value}))
    rows = [(*inputs, speed, *flags) for inputs, speed, flags in
            itertools.product(changed, SPEEDS, itertools.product((True, False), repeat=2))]  # fmt: skip
    *inputs, surge, fresh, measured = (np.array(column)[:, None] for column in zip(*rows, strict=True))
    sample = Sample(Inputs(*inputs), surge, fresh, measured & fresh)
    return tree_map(lambda x: x if x.dtype == bool else x.astype(dtype), sample)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_compiled_code_and_torch_decide_as_numpy(dtype):
    sample = edges(dtype)
    expected = masks(sample, LIMIT)
    assert all(mask.any() and not mask.all() for mask in expected)
    use = masks(tree_map(torch.from_numpy, sample), LIMIT)
    for name, mask in expected._asdict().items():
        np.testing.assert_array_equal(getattr(use, name), mask, err_msg=name)
    rows = np.empty((1, len(sample.surge), ROW), dtype)
    prepare_all(*sample.inputs, *sample[1:], True, LIMIT, rows)
    modes = np.select([expected.learns, expected.steps, expected.starts], [LEARN, PREDICT, START], HOLD)
    np.testing.assert_array_equal(rows[0, :, MODE], modes[:, 0])
    np.testing.assert_array_equal(rows[0, :, SURGE], np.where(expected.known, sample.surge, 0.0)[:, 0])


def test_masks_by_hand():
    """Of a step whose inputs or speed are no number, stale, not measured, implausible, or the start of a segment."""
    one = np.ones(7)
    dt = np.array([0.4, 0.4, 0.4, 0.4, 0.4, 0.0, -1.0])
    surge = np.array([1.0, np.nan, 1.0, LIMIT, 1.0, 1.0, 1.0])
    left = np.array([0.5, 0.5, 0.5, 0.5, np.nan, np.nan, 0.5])
    measured = np.array([1, 1, 0, 1, 1, 0, 1]) > 0
    use = masks(Sample(Inputs(left, one, one, one, dt), surge, one > 0, measured), LIMIT)
    assert use.learns.tolist() == [True, False, False, False, False, False, False]
    assert use.steps.tolist() == [True, True, True, True, False, False, False]
    assert use.starts.tolist() == [False, False, False, False, False, True, False]


def test_a_clean_sample_has_no_number_that_could_do_harm():
    sample = tree_map(torch.from_numpy, edges(np.float64))
    step = clean(sample, LIMIT)
    assert all(x.isfinite().all() for x in (*step.inputs, step.surge))
    assert (step.surge.abs() < LIMIT).all() and not (step.learns & ~step.steps).any()
