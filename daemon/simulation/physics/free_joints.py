"""A plant of independent joints that touch nothing: for servo buses without a hand, and for tests.

Each joint is a motor with first-order current, inertia, viscous and Coulomb friction, and the
servo's inner position loop in current; it is stepped with a fixed step, so a run is deterministic.
The defaults are about an XM430-W350 with nothing on its horn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.servos.control_table import CURRENT_MODE
from softfinger.kinematics.compiled.kernel import kernel

FloatArray = NDArray[np.float64]


@kernel
def _steps(
    count: int,
    dt: float,
    state: FloatArray,
    command: FloatArray,
    parameters: FloatArray,
) -> None:
    """``count`` semi-implicit steps. state [3, n]: q, dq, i; command [4, n]: on, mode, q*, i*."""
    inertia, viscous, coulomb, torque, lag, stiffness, damping = parameters
    for j in range(state.shape[1]):
        q, dq, i = state[0, j], state[1, j], state[2, j]
        on, mode, goal, bound = command[0, j], command[1, j], command[2, j], command[3, j]
        for _ in range(count):
            wanted = 0.0
            if on > 0.0:
                if mode == 0.0:
                    wanted = bound
                else:
                    wanted = stiffness * (goal - q) - damping * dq
                    wanted = min(max(wanted, -bound), bound)
            i += (wanted - i) * dt / lag
            if on == 0.0:
                i = 0.0
            drive = torque * i
            dq = (dq + drive * dt / inertia) / (1.0 + viscous * dt / inertia)
            slow = coulomb * dt / inertia
            if dq > slow:
                dq -= slow
            elif dq < -slow:
                dq += slow
            else:
                dq = 0.0
            q += dq * dt
        state[0, j], state[1, j], state[2, j] = q, dq, i


class FreeJoints:
    """``count`` joints at rest at angle 0, as a servo bus wants them."""

    def __init__(
        self,
        count: int = 2,
        start: float = 0.0,
        *,
        step: float = 0.0005,
        inertia: float = 0.002,  # kg·m², rotor through the gear
        viscous: float = 0.05,  # N·m·s/rad
        coulomb: float = 0.02,  # N·m
        torque_constant: float = 1.78,  # N·m/A
        current_lag: float = 0.001,  # s
        stiffness: float = 8.0,  # A/rad
        damping: float = 0.10,  # A·s/rad
    ) -> None:
        self._step = step
        self._start = start
        self._done = 0  # steps since start
        self._state = np.zeros((3, count))
        self._q: FloatArray = self._state[0]
        self._dq: FloatArray = self._state[1]
        self._current: FloatArray = self._state[2]
        self._command = np.zeros((4, count))
        self._parameters = np.array(
            [inertia, viscous, coulomb, torque_constant, current_lag, stiffness, damping]
        )
        _steps(0, step, self._state, self._command, self._parameters)  # compiled before it is due

    @property
    def q(self) -> FloatArray:
        """Joint angles [rad]; may be written to place the joints."""
        return self._q

    @property
    def dq(self) -> FloatArray:
        """Joint velocities [rad/s]."""
        return self._dq

    @property
    def current(self) -> FloatArray:
        """Motor currents [A]."""
        return self._current

    def advance(self, t: float) -> None:
        """Step up to time t [s]."""
        count = int((t - self._start) / self._step + 1e-9) - self._done
        if count > 0:
            self._done += count
            _steps(count, self._step, self._state, self._command, self._parameters)

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """What the servo of a joint is told from now on; see the plant's interface."""
        command = self._command
        command[0, joint] = float(torque_on)
        command[1, joint] = float(mode)
        command[2, joint] = goal_q
        command[3, joint] = goal_current if mode == CURRENT_MODE else abs(goal_current)
