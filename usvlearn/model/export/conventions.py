"""The drag and the mass of a boat under the names and with the signs of other simulators.

All three have a linear and a quadratic drag of motion ahead. Here (`docs/theory/model.md#surge-model`) and in Fossen's
MSS a drag is a force and therefore negative. In Gazebo there are two plugins with opposite signs:

    MSS                          (m − Xudot) du/dt = Xu u + Xuu |u| u + τ           Xu, Xuu, Xudot ≤ 0
    gz-sim Hydrodynamics         m du/dt = xDotU du/dt + (xU + xUabsU |u|) u + τ    all ≤ 0
    VRX SimpleHydrodynamics      m du/dt = −xDotU du/dt − (xU + xUU |u|) u + τ      all ≥ 0

The last is also that of VRX of Gazebo Classic and of PX4's USV dynamics. Speeds tell only the sum of mass and added
mass. So the added mass is given as 0: whoever knows the mass m of the boat alone sets it to the difference.

References: Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2021; the sources of MSS, gz-sim and VRX.
"""

from __future__ import annotations

from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.model.surge import SurgeModel

NOTE = (
    "mass contains the added mass, which speeds do not tell apart, so Xudot and xDotU are 0. These names have no drag "
    "of turning, and no loss of thrust with speed: where thrust_speed is not 0, steady speeds differ."
)


def conventions(model: SurgeModel) -> dict[str, dict[str, float]]:
    """Mass, kg, and drag of motion ahead, kg/s and kg/m, by simulator and its names; thrust at standstill, N.

    >>> from usvlearn.model.surge import WITHOUT_EVEN
    >>> drag = {"drag_quadratic": -1.5, "drag_linear": -14.0}
    >>> names = conventions(SurgeModel(28.0, {**dict.fromkeys(WITHOUT_EVEN, 0.0), **drag}))
    >>> names["mss"]["Xu"], names["gz_sim"]["xUabsU"], names["vrx"]["xUU"]
    (-14.0, -1.5, 1.5)
    """
    boat, mass = model.ahead, model.mass
    linear, quadratic = mass * float(boat.linear), mass * float(boat.quadratic)
    thrust = {f"thrust_full_{side}": mass * float(boat.thrust(1.0, side)) for side in SIDES}
    return {
        "mss": {"m": mass, "Xudot": 0.0, "Xu": linear, "Xuu": quadratic, **thrust},
        "gz_sim": {"mass": mass, "xDotU": 0.0, "xU": linear, "xUabsU": quadratic, **thrust},
        "vrx": {"mass": mass, "xDotU": 0.0, "xU": -linear, "xUU": -quadratic, **thrust},
    }
