"""What is counted over the networks of a comparison: shares, medians, contingency tables, the theorem's ratio."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from certify.analysis.confidence import median, median_interval, wilson

GAUGED = {"simple": "simple, best gauge", "gershgorin": "gershgorin, best gauge"}
TIERS = ("simple", GAUGED["simple"], "gershgorin", GAUGED["gershgorin"], "lmi", "tight", "interval", "box")
SEEN = TIERS[:6]  # those that know a and w₁ alone
SPREAD = (0.05, 0.95)  # quantiles between which most networks lie


def summarise(rows: Sequence[dict[str, Any]], drawn: bool = True) -> dict[str, dict[str, Any]]:
    """Per condition: how many networks it certifies, its smallest rate over K, the largest rate and time constant.

    Args:
        rows: see `certify.command.compare.examine`.
        drawn: whether they are independent draws; otherwise there are no intervals.

    Returns:
        Of each condition: certified, of, share, share_interval (Wilson, 95 %), conservatism (median of rate/K over the
        networks with K > 0; None if it is infinite), conservatism_interval (order statistics, 95 %), largest_K (of a
        network that it certifies; of interval and box the rate that they prove), largest_steps (−1/ln K) and
        largest_time_constant (−dt/ln K, s), disagreements (of the solver with the closed form).
    """
    summary: dict[str, dict[str, Any]] = {}
    for tier in TIERS:
        ratios = [math.inf if row["rates"][tier] is None else row["rates"][tier] / row["K"] for row in rows if row["K"]]
        held = [row for row in rows if row["certified"][tier]]
        proved = [min(row["K"], row["rates"][tier]) if tier in ("interval", "box") else row["K"] for row in held]
        steps = [steps_of(rate) for rate in proved]
        constants = [x * row["dt"] for x, row in zip(steps, held, strict=True) if row.get("dt") and x is not None]
        solved = [(row["solved"][tier]["verdict"] == "certified", row) for row in rows if tier in row.get("solved", {})]
        summary[tier] = {
            "certified": len(held),
            "of": len(rows),
            "share": len(held) / len(rows),
            "share_interval": list(wilson(len(held), len(rows))) if drawn else None,
            "conservatism": _finite(median(ratios)) if ratios else None,
            "conservatism_interval": _interval(ratios) if drawn else None,
            "largest_K": max(proved, default=None),
            "largest_steps": max((x for x in steps if x is not None), default=None),
            "largest_time_constant": max(constants, default=None),
            "disagreements": sum(said != row["certified"][tier] for said, row in solved) if solved else None,
        }
    return summary


def steps_of(rate: float) -> float | None:
    """The time constant −1/ln K in steps; None where K ≥ 1.

    >>> steps_of(0.5), steps_of(0.0), steps_of(1.0)
    (1.4426950408889634, 0.0, None)
    """
    if rate >= 1:
        return None
    return 0.0 if rate <= 0 else -1 / math.log(rate)


def contingency(rows: Sequence[dict[str, Any]], drawn: bool = True) -> dict[str, dict[str, Any]]:
    """The LMI against Gershgorin's lemma, as given and in its best gauge: both, one alone, or neither certifies.

    `only_gershgorin` is 0 by the theorem. `missed` is the share of the LMI's networks that the lemma does not certify.
    """
    found = {}
    for name, tier in (("as given", "gershgorin"), ("best gauge", GAUGED["gershgorin"])):
        pairs = [(row["certified"]["lmi"], row["certified"][tier]) for row in rows]
        count = {(one, other): pairs.count((one, other)) for one in (True, False) for other in (True, False)}
        by_lmi = count[True, True] + count[True, False]
        found[name] = {
            "both": count[True, True],
            "only_lmi": count[True, False],
            "only_gershgorin": count[False, True],
            "neither": count[False, False],
            "missed": count[True, False] / by_lmi if by_lmi else None,
            "missed_interval": list(wilson(count[True, False], by_lmi)) if by_lmi and drawn else None,
        }
    return found


def conservatism(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Of each condition that knows a and w₁ alone: median, its interval, and the spread of rate/K (`over_K`)."""
    return {tier: middle([row["over_K"][tier] for row in rows]) for tier in SEEN}


def middle(values: Sequence[float], drawn: bool = True) -> dict[str, Any]:
    """Median, its 95 % interval, and the quantiles SPREAD; None where infinite."""
    ordered = sorted(values)
    low, high = (ordered[round(q * (len(ordered) - 1))] for q in SPREAD)
    return {
        "median": _finite(median(values)),
        "interval": _interval(values) if drawn else None,
        "spread": [_finite(low), _finite(high)],
        "least": _finite(ordered[0]),
        "greatest": _finite(ordered[-1]),
    }


def of_losses(rows: Sequence[dict[str, Any]], drawn: bool = True) -> dict[str, Any]:
    """Of the theorem's check: how many networks have a slope, σ/K over them, how many have one sign, what failed."""
    known = [row["loss"] for row in rows if row["loss"] is not None]
    return {
        "with_slope": len(known),
        "without_slope": len(rows) - len(known),
        "one_sign": sum(each["one_sign"] for each in known),
        "false": sorted({name for each in known for name in each["false"]}),
        "ratio": middle([each["ratio"] for each in known], drawn) if known else None,
    }


def _interval(values: Sequence[float]) -> list[float | None] | None:
    found = median_interval(values)
    return None if found is None else [_finite(x) for x in found]


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None
