"""The table of the identified quantities of turning, for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rich.console import Group
from rich.text import Text

from usvlearn.display.terminal import Blocks
from usvlearn.engine.identified import sentences
from usvlearn.estimators.axis.turning_quantities import MEANING, QUANTITIES
from usvlearn.estimators.joint.reading import Identified, shown


def turning_table(
    found: Mapping[str, Identified],
    truth: Mapping[str, Mapping[str, float]] | None = None,
    said: Mapping[str, Identified] | None = None,
) -> Group:
    """Quantities of turning with their 90 % intervals, boat by boat; nothing is printed where there are none.

    Args:
        found: of each boat (`usvlearn.evaluation.identification.identified_planar_boats`).
        truth: boat -> quantity -> value.
        said: what is printed above it of the surge, whose sentences are not repeated.
    """
    turning = {boat: each for boat, each in found.items() if QUANTITIES.keys() <= each.keys()}
    if not turning:
        return Group()
    known = {boat: values for boat, values in (truth or {}).items() if QUANTITIES.keys() & values.keys()}
    heads = ["value", "from", "to", *(["truth"] if known else []), "unit"]
    table = Blocks("Identified turning, with 90 % intervals", ["quantity"], heads)
    for boat, quantities in turning.items():
        if len(turning) > 1:
            table.group(boat)
        own = known.get(boat, {})
        for name in QUANTITIES:
            *numbers, unit = quantities.displayed(name)
            true = [shown(own[name]) if name in own else "–"] if known else []
            table.add(name, *map(shown, numbers), *true, unit)
    above = {boat: each.lacks for boat, each in (said or {}).items()}
    own_lacks = {
        boat: replace(each, basis="", scale="", lacks=tuple(x for x in each.lacks if x not in above.get(boat, ())))
        for boat, each in turning.items()
    }
    return Group(Text(), table, *map(Text, [MEANING, *sentences(own_lacks)]))
