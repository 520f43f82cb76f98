"""What speaks against the use of a fit, one sentence each with what to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.estimators.joint.lacking import Quantity
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.model.fit.gauss_newton import LAGS, TIMES, Fit
from usvlearn.model.fit.quantities import CurvedAhead
from usvlearn.model.fit.terms import PLACE_LAG, PLACE_TIME

DRAG = ("drag_quadratic", "drag_linear", "drag_cross")
TINY = 1e-6  # of the drag at half speed: a smaller force is rounding
FOLLOW = 1.5  # 99 % bounds, beyond which errors follow a command: with that many lags, some are beyond one by chance


def doubts(
    fit: Fit, found: Mapping[str, Quantity], cross: Mapping[str, Any], online: Mapping[str, Quantity] | None
) -> tuple[str, ...]:
    """What speaks against the use of a fit; () where nothing does.

    Args:
        fit: the chosen one.
        found: its quantities.
        cross: correlations of its errors with commands (`usvlearn.model.fit.diagnostics`).
        online: what was identified online, if anything.
    """
    said, least = [], TINY * abs(found["drag_half_speed"].value)
    if pushes := [name for name in DRAG if found[name].value > least]:
        said.append(
            f"{' and '.join(pushes)} would push the boat: the logs do not tell how its drag splits. Give longer logs, "
            "with turns and commands from low to full."
        )
    if not CurvedAhead(fit.theta, fit.top).brakes:
        said.append("The drag does not grow with the speed everywhere: check the speed channel, or give longer logs.")
    if fit.theta[PLACE_LAG] >= LAGS[1] or fit.theta[PLACE_TIME] >= TIMES[1]:
        said.append(
            "The lag of the thrust is at its bound: the speed follows the commands later than the fit allows. Find the "
            "delay by usvlearn delay, set data.channels.command_left.delay and command_right.delay, and train again."
        )
    for name, what in (("mean", "mean command"), ("difference", "difference of the commands")):
        lags, values, bounds = (np.array(cross[name][key], float) for key in ("lags", "values", "bounds"))
        over = np.nan_to_num(np.abs(values) / bounds)[lags >= 0]
        if over.max(initial=0.0) > FOLLOW:
            said.append(
                f"The errors of the simulation follow the {what}, most after {lags[lags >= 0][over.argmax()]:g} s: the "
                "model lacks something. Check the commands' delay, zero and sides, and the rate of the speed."
            )
    apart = [
        name for name, each in found.items()
        if online is not None and name in online and name not in SURGE
        and (online[name].low > each.high or online[name].high < each.low)
    ]  # fmt: skip
    if apart:
        said.append(
            f"The intervals of fit and online estimate do not meet for {', '.join(apart)}: one is wrong, or the boat "
            "has changed. Fit the missions before and after a change apart."
        )
    return tuple(said)
