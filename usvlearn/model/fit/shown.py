"""The tables of a batch fit for the terminal."""

from __future__ import annotations

import math

from rich.console import RenderableType
from rich.text import Text

from usvlearn.display.terminal import Blocks
from usvlearn.estimators.axis.turning_quantities import MEANING_OF_FIT
from usvlearn.estimators.joint.periodic_estimates import Identified, shown
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.model.fit.fitted import Fitted

FEW, MORE = 3, "The logs lack more: add --all."  # sentences that are shown first
USE = "Use the values of the fit: it has learned from all missions at once, online each sample is seen once."
MAIN = (
    "steady_speed_full", "steady_speed_half", "time_constant", "stopping_distance", "thrust_full_left",
    "thrust_full_right", "drag_half_speed", "yaw_rate_full", "turning_radius_full", "thrust_lag", "dead_zone",
    "compass_offset", "current",
)  # fmt: skip  # what is shown first


def tables(fitted: Fitted, online: Identified | None, whole: bool = True) -> list[RenderableType]:
    """The quantities beside those learned online, the sets of terms, and what they mean; not `whole`: the main ones."""
    use, boat = "" if fitted.doubts else " (use)", fitted.identified
    beside = (["online", "from", "to"] if whole else ["online"]) if online is not None else []
    table = Blocks(
        f"{fitted.boat}: fitted to all missions, with 90 % intervals", ["quantity"],
        [f"fit{use}", "from", "to", *beside, "unit"],
    )  # fmt: skip
    for name in fitted.quantities if whole else (each for each in MAIN if each in fitted.quantities):
        learned = online.displayed(name)[:3] if online is not None and name in online else (math.nan,) * 3
        cells = [*boat.displayed(name)[:3], *learned[: len(beside)]]
        table.add(name, *map(shown, cells), fitted.quantities[name].unit)
    many = "1 mission errs" if fitted.missions.number == 1 else f"{fitted.missions.number} missions err"
    doubts = ["Do not use the values of the fit before this is settled:", *fitted.doubts] if fitted.doubts else [USE]
    lacks = [each for each in boat.lacks if each not in fitted.doubts]
    if not whole:
        return [table, *map(Text, [*doubts, *lacks[:FEW]]), *[Text(MORE)] * (len(lacks) > FEW)]
    sets = Blocks(
        "Terms, by their loss on missions that they have not learned", ["set"], ["parameters", "worse by", "±", "MAE"]
    )
    for name, score in fitted.scores.items():
        worse, error = (f"{x:.4f}" if math.isfinite(x) else "–" for x in (0.0 - score.gain, score.error))
        used = f"{name} (used)" if name == fitted.chosen else name
        worse, error = ("–", "–") if name == fitted.chosen else (worse, error)
        sets.add(used, str(len(fitted.fits[name].known.active)), worse, error, f"{fitted.errors[name]:.4f}")
    lines = [
        MEANING,
        MEANING_OF_FIT,
        *doubts,
        f"In open loop, {many} by {fitted.errors[fitted.chosen]:.4f} m/s; speeds are {boat.late:.1f} s late.",
        *([] if fitted.simulation is None else [fitted.simulation.sentence]),
        boat.scale,
        *lacks,
    ]
    return [table, Text(), sets, *map(Text, lines)]
