"""What a person is told of an `Online`: its last step, and why that predicted nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.samples import PlanarSample, Sample, tree_map, why_no_step

Last = tuple[Sample | PlanarSample, Any] | None  # of the last step: its sample and the predicted surge, m/s


def why(last: Last) -> str | list[str]:
    """Why a step returned NaN, in words; "" if it returned a number. Of a batch a list."""
    if last is None:
        return "no step was made yet"
    sample, predicted = last
    sample = sample.sample if isinstance(sample, PlanarSample) else sample
    if batch := np.shape(predicted):
        wide = tree_map(lambda leaf: np.broadcast_to(np.asarray(leaf), batch).reshape(-1), sample)
        each = zip(np.ravel(predicted), range(predicted.size), strict=True)
        return [_why(tree_map(lambda leaf, k=k: leaf[k].item(), wide), value) for value, k in each]
    return _why(sample, predicted)


def _why(sample: Sample, predicted: float) -> str:
    if np.isfinite(predicted):
        return ""
    return why_no_step(sample) or "no estimator predicts: give a measured speed first, with dt=0"


def facts(name: str, names: Sequence[str], batch: tuple[int, ...], last: Last) -> list[tuple[str, str]]:
    """The estimator, the vehicles and the last step, by title."""
    of = f" of {', '.join(names)}" if names else ""
    found = [("estimator", f"{name}{of}"), ("vehicles", f"{batch}" if batch else "1")]
    if last is None or batch:
        return [*found, ("last step", "none yet" if last is None else "made")]
    return [*found, ("last step", str(why(last)) or f"predicted {last[1]:.3f} m/s")]


def intervals(predicted: Mapping[str, tuple[Any, Any]]) -> list[tuple[str, str]]:
    """What each member and combiner predicted, with its interval."""
    return [(name, f"{surge:.3f} ± {width:.3f} m/s (90 %)") for name, (surge, width) in predicted.items()]
