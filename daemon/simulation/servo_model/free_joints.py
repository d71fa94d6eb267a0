"""Simulate independent joints for a servo bus without a hand.

Each joint has inertia, viscous friction and Coulomb friction. The servo's position loop commands
the current, which responds with a first-order lag. A fixed step makes runs deterministic. The
constants approximate an XM430-W350 with a bare horn.
"""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STEP = 0.0005  # s
INERTIA = 0.002  # rotor inertia reflected to the gearbox output [kg·m²]
VISCOUS = 0.05  # N·m·s/rad
COULOMB = 0.02  # N·m
TORQUE_CONSTANT = 1.78  # N·m/A
CURRENT_LAG = 0.001  # s
STIFFNESS = 8.0  # A/rad
DAMPING = 0.10  # A·s/rad
STALL = 3.21  # stall current at full supply voltage [A]


class FreeJoints:
    """``count`` joints that implement :class:`JointPlant`, initially at rest at angle 0."""

    def __init__(self, count: int = 2, start: float = 0.0) -> None:
        self._start = start
        self._done = 0  # number of steps since the start
        self.q: FloatArray = np.zeros(count)  # joint angles [rad]; callers may change the angles
        self.dq: FloatArray = np.zeros(count)  # rad/s
        self.current: FloatArray = np.zeros(count)  # A
        # Torque-on flag, signed current, angle, and current limit of each joint.
        self._goals = [(False, 0.0, 0.0, 0.0)] * count
        # Stiffness, damping and duty of each joint; see `tune`.
        self._tuned = [(1.0, 0.0, 1.0)] * count

    def measured_current(self, joint: int) -> float:
        """Return the measured current; see :meth:`JointPlant.measured_current`."""
        return self.current.item(joint)

    def advance(self, t: float) -> None:
        """Advance to time t [s]."""
        count = int((t - self._start) / STEP + 1e-9) - self._done
        if count > 0:
            self._done += count
            for joint in range(len(self.q)):
                self._advance(joint, count)

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set a servo's mode and goals; see :meth:`JointPlant.drive`."""
        if mode == 0:
            self._goals[joint] = torque_on, goal_current, 0.0, 0.0
        else:
            self._goals[joint] = torque_on, 0.0, goal_q, abs(goal_current)

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's gains and PWM limit; see :meth:`JointPlant.tune`."""
        self._tuned[joint] = stiffness, damping, duty

    def _advance(self, joint: int, count: int) -> None:
        q, dq, current = (float(each[joint]) for each in (self.q, self.dq, self.current))
        torque_on, fixed, goal, bound = self._goals[joint]
        stiffness, damping, duty = self._tuned[joint]
        stiffness, damping = STIFFNESS * stiffness, DAMPING + STIFFNESS * damping
        most = STALL * duty
        for _ in range(count):
            wanted = min(max(stiffness * (goal - q) - damping * dq, -bound), bound) + fixed
            wanted = min(max(wanted, -most), most)
            current = current + (wanted - current) * STEP / CURRENT_LAG if torque_on else 0.0
            dq += TORQUE_CONSTANT * current * STEP / INERTIA
            dq /= 1.0 + VISCOUS * STEP / INERTIA
            slow = COULOMB * STEP / INERTIA
            dq -= min(max(dq, -slow), slow)
            q += dq * STEP
        self.q[joint], self.dq[joint], self.current[joint] = q, dq, current
