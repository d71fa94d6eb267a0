"""The kernels of the grip laws and their memory's layout; what they are for: :mod:`control.grip`.

Pure functions on arrays: ``g`` the laws' memory, ``h`` what the grip was told of the held object
(`perception.contact_filter_kernels`), ``force`` and ``angle`` the memories of two references
(`control.setpoint`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.control.setpoint import SPEED, TARGET, advance, arrived
from softfinger.daemon.perception.contact_filter_kernels import (
    ANGLE_STD,
    ARM,
    JOINT,
    LEVER,
    NORMAL,
    SLIDE,
    TIP_SIZE,
    TIP_STIFFNESS,
    TURN,
)
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel

FloatArray = NDArray[np.float64]

_INTEGRAL_SHARE = 0.3  # the integral's bound, as a share of the force wanted
_SHARE_BANDWIDTH = 2.0  # Hz of the integral of the tips' difference
_SHARE_ANGLE = 3e-3  # rad that the object may turn by that
_QUIET = 3.0  # standard deviations of the angle that the joints at rest don't follow
_STIFFNESS_MIN = 100.0  # N/m, below which a contact is too light to scale by
_TURN_MIN = 0.1  # of the object over a joint's lean, likewise

# Places in the laws' memory. What is set once:
DT, FORCE_GAIN, FORCE_BANDWIDTH, ROTATE_BANDWIDTH, ROTATE_SPEED = 0, 1, 2, 3, 4
DAMPING = 5  # 2 ζ √J, times √stiffness the damping [N·m·s/rad]
FRICTION, FRICTION_SPEED = 6, 7  # of a joint [N·m], and from which speed on all of it [rad/s]
TORQUE_MAX = 8  # N·m
BY_ENERGY = 9  # 1: the lever is the tables' energy's
REST = 10  # what is left of a turning a tick later without frames
# What a command sets:
JOINT_STIFFNESS = 11  # N·m/rad
FORCE_RATE = 12  # N/s
STEERING = 13  # 1: the object's angle is gone to
# What the laws remember:
INTEGRAL = 14  # N
PUSH = 15  # N that the joints give, both laws' parts together
LEAN = 16  # rad/s of the offset that turns the object
OFFSET = 17  # goal of (q1 − q2)/2 [rad]
SHIFT = 18  # of the offset, to share the force out between the tips [rad]
CLOSED = 19  # goal of (q1 + q2)/2 in pure position control [rad]
CLOSING_FRICTION = 20  # share of the joints' friction that is given for closing
TORQUE = 21  # last of both joints [N·m]
MEMORY = 23


@kernel
def squeeze(
    g: FloatArray,
    force: FloatArray,
    angle: FloatArray,
    h: FloatArray,
    felt: float,
    turned: float,
    dq1: float,
    dq2: float,
) -> tuple[float, float]:
    """Torques of both joints [N·m] for the mean force ``felt`` and the object's angle ``turned``.

    An angle that is not known is NaN.
    """
    wanted = advance(force, g[FORCE_RATE])
    g[PUSH] = wanted + _correction(g, force[TARGET], wanted, felt)
    lean = 0.0
    if g[STEERING] > 0.0:
        lean = _steer(g, angle, h, turned)
    g[LEAN] = lean
    if arrived(force) and not (g[STEERING] > 0.0 and not arrived(angle)):
        _share_out(g, h)
    close = _closing(h, force[SPEED], lean)
    g[CLOSING_FRICTION] = min(max(close / g[FRICTION_SPEED], -1.0), 1.0)
    return _give(g, h, close, lean, dq1, dq2)


@kernel
def coast(g: FloatArray, h: FloatArray, dq1: float, dq2: float) -> tuple[float, float]:
    """In the place of `squeeze` while frames are late: the push stays, turning comes to rest."""
    g[LEAN] *= g[REST]
    g[OFFSET] += g[LEAN] * g[DT]
    return _give(g, h, _closing(h, 0.0, g[LEAN]), g[LEAN], dq1, dq2)


@kernel
def press(
    g: FloatArray, force: FloatArray, h: FloatArray, finger: int, felt: float, dq: float
) -> float:
    """Torque [N·m] of one ``finger`` on an object that stands by itself."""
    wanted = advance(force, g[FORCE_RATE])
    g[PUSH] = wanted + _correction(g, force[TARGET], wanted, felt)
    return _press(g, h, finger, force[SPEED], dq)


@kernel
def coast_alone(g: FloatArray, h: FloatArray, finger: int, dq: float) -> float:
    """In the place of `press` while frames are late."""
    return _press(g, h, finger, 0.0, dq)


@kernel
def place(
    g: FloatArray,
    force: FloatArray,
    angle: FloatArray,
    h: FloatArray,
    felt: float,
    turned: float,
) -> tuple[float, float]:
    """Goals of both joints [rad] of pure position control: both references moved into angles."""
    error = advance(force, g[FORCE_RATE]) - felt
    arm = 0.5 * (h[ARM] + h[ARM + 1])
    lean = 0.0
    if g[STEERING] > 0.0:
        lean = _steer(g, angle, h, turned)
    way = g[FORCE_BANDWIDTH] * error / (_mean_stiffness(h) * arm)
    g[CLOSED] += (_closing(h, force[SPEED], lean) + way) * g[DT]
    return g[CLOSED] + g[OFFSET], g[CLOSED] - g[OFFSET]


@inner_kernel
def _mean_stiffness(h: FloatArray) -> float:
    mean: float = 0.5 * (h[TIP_STIFFNESS] + h[TIP_STIFFNESS + TIP_SIZE])
    return max(mean, _STIFFNESS_MIN)


@inner_kernel
def _turning(h: FloatArray) -> float:
    """How far the object turns when one joint leans forward and the other back."""
    both: float = h[TURN] + h[TURN + 1]
    return max(both, _TURN_MIN)


@inner_kernel
def _correction(g: FloatArray, target: float, wanted: float, felt: float) -> float:
    """What the force felt asks for beyond the feed-forward [N]."""
    error = wanted - felt
    # Beyond what the servos may give, more error must not be stored.
    full = abs(g[TORQUE]) >= g[TORQUE_MAX] or abs(g[TORQUE + 1]) >= g[TORQUE_MAX]
    if not full or error < 0.0:
        integral = g[INTEGRAL] + g[FORCE_BANDWIDTH] * error * g[DT]
        bound = _INTEGRAL_SHARE * target
        g[INTEGRAL] = min(max(integral, -bound), bound)
    correction: float = g[FORCE_GAIN] * error + g[INTEGRAL]
    return correction


@inner_kernel
def _steer(g: FloatArray, angle: FloatArray, h: FloatArray, turned: float) -> float:
    """Move the antisymmetric goal; returns its rate [rad/s]."""
    wanted = advance(angle, g[ROTATE_SPEED])
    turn = _turning(h)
    lean: float = angle[SPEED] / turn
    if not math.isnan(turned):
        error = wanted - turned
        if arrived(angle):  # what is no more than noise, joints at rest shall not follow
            noise = _QUIET * h[ANGLE_STD]
            error -= min(max(error, -noise), noise)
        g[OFFSET] += g[ROTATE_BANDWIDTH] * error / turn * g[DT]
    g[OFFSET] += lean * g[DT]
    return lean


@inner_kernel
def _share_out(g: FloatArray, h: FloatArray) -> None:
    """Take out what the object's rubbing on the table has put between the tips.

    The force law holds their mean; friction may keep the object where one tip is pressed more.
    Both fingers then shift sideways by a little, less than the object's angle is held to.
    """
    arm = 0.5 * (h[ARM] + h[ARM + 1])
    off = 0.5 * (h[NORMAL] - h[NORMAL + 1]) / (_mean_stiffness(h) * arm)
    most = _SHARE_ANGLE / _turning(h)
    shift = g[SHIFT] - 2.0 * math.pi * _SHARE_BANDWIDTH * off * g[DT]
    shift = min(max(shift, -most), most)
    g[OFFSET] += shift - g[SHIFT]
    g[SHIFT] = shift


@inner_kernel
def _closing(h: FloatArray, rate: float, lean: float) -> float:
    """Closing [rad/s] for a ``rate`` [N/s] of the force, what turning takes counted in."""
    way = 2.0 * rate / _mean_stiffness(h)
    way -= (h[ARM] - h[ARM + 1] + h[SLIDE] * (h[TURN] + h[TURN + 1])) * lean
    closing: float = way / (h[ARM] + h[ARM + 1])
    return closing


@inner_kernel
def _give(
    g: FloatArray, h: FloatArray, close: float, lean: float, dq1: float, dq2: float
) -> tuple[float, float]:
    """Torques of two fingers at rates [rad/s] of closing and leaning that are wanted."""
    push = g[PUSH]
    arm = 0.5 * (h[ARM] + h[ARM + 1])
    calm = g[DAMPING] * math.sqrt(_mean_stiffness(h) * arm * arm) * (close - 0.5 * (dq1 + dq2))
    error = g[OFFSET] - 0.5 * (h[JOINT] - h[JOINT + 1])
    turn = g[JOINT_STIFFNESS] * error
    turn += g[DAMPING] * math.sqrt(g[JOINT_STIFFNESS]) * (lean - 0.5 * (dq1 - dq2))
    lever = LEVER if g[BY_ENERGY] > 0.0 else ARM
    g[TORQUE] = h[lever] * push + calm + turn + _friction(g, close + lean)
    g[TORQUE + 1] = h[lever + 1] * push + calm - turn + _friction(g, close - lean)
    return g[TORQUE], g[TORQUE + 1]


@inner_kernel
def _press(g: FloatArray, h: FloatArray, finger: int, rate: float, dq: float) -> float:
    """Torque [N·m] of one finger whose force is to change by ``rate`` [N/s]."""
    arm = h[ARM + finger]
    stiffness = max(h[TIP_STIFFNESS + TIP_SIZE * finger], _STIFFNESS_MIN)
    close = rate / (stiffness * arm)
    calm = g[DAMPING] * math.sqrt(stiffness * arm * arm) * (close - dq)
    torque: float = arm * g[PUSH] + calm + _friction(g, close)
    g[TORQUE + finger] = torque
    return torque


@inner_kernel
def _friction(g: FloatArray, rate: float) -> float:
    """What a joint's friction takes [N·m] at the ``rate`` [rad/s] that is wanted."""
    friction: float = g[FRICTION] * min(max(rate / g[FRICTION_SPEED], -1.0), 1.0)
    return friction
