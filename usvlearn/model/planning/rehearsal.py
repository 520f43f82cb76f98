"""What a boat's averaged joint EKF would know after a mission that has not been sailed: it goes through the course.

The covariance recursion of the joint EKF (`usvlearn.estimators.joint.state`) depends on the inputs and on the mean,
and not on what is measured. So each step predicts the speed and learns that prediction: the mean stays at the model's,
and the covariance falls by the Fisher information of the step, as if the step had been measured. The noise σ² stays as
it is. `identify` makes the intervals, as after a mission. See `docs/theory/identification.md#input-design`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.jit import announced, jit
from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, RIGHT, ROW
from usvlearn.engine import select_element
from usvlearn.engine.identified import reader_leaves
from usvlearn.engine.planar_plan import program_for
from usvlearn.estimators.joint.kernel import forecast, learn, start
from usvlearn.estimators.joint.periodic_estimates import Identified, identify
from usvlearn.estimators.joint.state import AT, NORTH, THETA


class Rehearsed(NamedTuple):
    """What is expected after a course."""

    found: Identified
    speed: np.ndarray  # (steps,) through the water, m/s


class Rehearsal:
    """Rehearses courses from the state of a boat's averaged joint EKF.

    Args:
        members: descriptions of the estimators by name.
        leaves: of the state, by dotted name, without batch axes.

    Raises:
        ConfigError: none of the members is an averaged joint EKF.
    """

    def __init__(self, members: Mapping[str, Mapping[str, Any] | None], leaves: Mapping[str, np.ndarray]):
        description, own = reader_leaves(members, leaves)
        self.description = select_element(description, 1, 0)
        self._plan = program_for(self.description, (), np.dtype(float))
        self._node = self._plan.program[1]
        self._state = self._plan.pack({key: leaf.astype(float) for key, leaf in own.items()})
        self.current: np.ndarray = own["mean"][NORTH:THETA].astype(float)  # (2,) north and east, m/s
        self.found = identify(self.description, own)

    def __call__(self, rows: np.ndarray) -> Rehearsed:
        """What is expected after a course, which starts at rest; the state stays as it was.

        Args:
            rows: of the course, `(steps, ROW)`.
        """
        state = self._state.copy()
        speed = self._advanced(state, rows, begin=True)
        return Rehearsed(self._identified(state), speed)

    def top_speed(self, command: float) -> float:
        """The speed through the water after a minute at a command of both sides, m/s."""
        rows = np.zeros((150, ROW))
        rows[:, [LEFT, RIGHT]], rows[:, DT], rows[:, COS], rows[:, MODE] = command, 0.4, 1.0, LEARN
        return float(self(rows).speed[-1])

    def by_part(self, rows: np.ndarray, ends: np.ndarray) -> list[Rehearsed]:
        """What is expected after each part of a course.

        Args:
            rows: of the course, `(steps, ROW)`.
            ends: the step behind each part, ascending.
        """
        state, found, first = self._state.copy(), [], 0
        for last in ends.tolist():
            speed = self._advanced(state, rows[first:last], begin=first == 0)
            found.append(Rehearsed(self._identified(state), speed))
            first = last
        return found

    def _advanced(self, state: np.ndarray, rows: np.ndarray, begin: bool) -> np.ndarray:
        speed, work = np.empty(len(rows)), np.empty(self._plan.work)
        with announced(__file__, "rehearsal"):
            _rehearse(self._node, state[0], self._plan.numbers[0], np.ascontiguousarray(rows), begin, work, speed)
        return speed

    def _identified(self, state: np.ndarray) -> Identified:
        return identify(self.description, {key: leaf.copy() for key, leaf in self._plan.unpack(state).items()})


@jit(entry=True)
def _rehearse(node, s, q, rows, begin, work, speed):
    """Learn each step's own prediction; the noise stays as it is."""
    noise = s[node[AT.noise]]
    if begin:
        start(node, s, q, 0.0)
    for k in range(len(rows)):
        predicted = forecast(node, s, q, rows[k], work)
        learn(node, s, q, rows[k], predicted, predicted, work)
        s[node[AT.noise]] = noise
        speed[k] = s[node[AT.mean]]
