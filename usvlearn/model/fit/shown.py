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

USE = "Use the values of the fit: it has learned from all missions at once, online each sample is seen once."


def tables(found: Fitted, online: Identified | None) -> list[RenderableType]:
    """The quantities beside those learned online, the sets of terms, and what they mean."""
    use = "" if found.doubts else " (use)"
    heads = [f"fit{use}", "from", "to", *(["online", "from", "to"] if online is not None else []), "unit"]
    table = Blocks(f"{found.boat}: fitted to all missions, with 90 % intervals", ["quantity"], heads)
    for name, each in found.quantities.items():
        beside = [shown(x) for x in online.displayed(name)[:3]] if online is not None and name in online else []
        beside = beside or ["–"] * (3 if online is not None else 0)
        table.add(name, *map(shown, found.found.displayed(name)[:3]), *beside, each.unit)
    sets = Blocks(
        "Terms, by their loss on missions that they have not learned", ["set"], ["parameters", "worse by", "±", "MAE"]
    )
    for name, score in found.scores.items():
        worse, error = (f"{x:.4f}" if math.isfinite(x) else "–" for x in (0.0 - score.gain, score.error))
        used = f"{name} (used)" if name == found.chosen else name
        worse, error = ("–", "–") if name == found.chosen else (worse, error)
        sets.add(used, str(len(found.fits[name].known.active)), worse, error, f"{found.errors[name]:.4f}")
    many = "1 mission errs" if found.missions.number == 1 else f"{found.missions.number} missions err"
    lines = [
        MEANING,
        MEANING_OF_FIT,
        *(["Do not use the values of the fit before this is settled:", *found.doubts] if found.doubts else [USE]),
        f"In open loop, {many} by {found.errors[found.chosen]:.4f} m/s; speeds are {found.found.late:.1f} s late.",
        *([] if found.simulation is None else [found.simulation.sentence]),
        found.found.scale,
        *(each for each in found.found.lacks if each not in found.doubts),
    ]
    return [table, Text(), sets, *map(Text, lines)]
