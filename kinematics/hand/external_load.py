"""The load on a held object along its faces, from the joints' torques and the tips' pressure.

A pressure grid feels no shear. The joints do: what the normal forces and the tips' turning moments
don't explain of their torques is shear, times its lever about the pivot. Pure kernels on the
coordinates and signs of :mod:`hand.grasp_state`; the joints are at rest.
"""

from __future__ import annotations

import math

from numpy import float64
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import Motion, Two, sheared_gradient

_STEPS = 4  # of Newton's method; the equation is a parabola, all but a line
_LEAST_SLOPE = 0.2  # of what it is where no tip is tilted


@inner_kernel
def _unexplained(
    data: NDArray[float64],
    d: float,
    theta: float,
    side: float,
    shear: float,
    torque: float,
    arm: float,
    lever: float,
) -> tuple[float, float]:
    """side (τ − N arm) − ∂U/∂θ − T lever of one tip [N·m], and how fast it falls with T [m]."""
    contact = lookup(data, d, theta)
    force, _, force_d, force_theta, _, _, _ = contact
    by_d, by_theta = sheared_gradient(contact, d, theta, shear)
    sine = math.sin(theta)
    cosine = math.cos(theta)
    tangent = sine / cosine
    bend = 0.5 * (shear / force - sine) / cosine
    bend_t = 0.5 / (force * cosine)
    stretch_t = d * bend_t * (sine + 2.0 * cosine * bend)
    normal_t = force_d * stretch_t - 2.0 * force * cosine * bend * bend_t - tangent
    theta_t = force_theta * stretch_t + force * d * bend_t * (cosine - 2.0 * sine * bend)
    left = side * (torque - (by_d - shear * tangent) * arm) - by_theta - shear * lever
    return left, side * arm * normal_t + theta_t + lever


@inner_kernel
def load_by_torques(
    data1: NDArray[float64],
    data2: NDArray[float64],
    d: Two,
    theta: Two,
    taper: float,
    motion: Motion,
    rolled: Two,
    torques: Two,
) -> tuple[float, float]:
    """(L, lever): the share L [N] that each tip bears of a load 2 L along the object's t.

    Solves for L, in the least squares of both joints' torques, that

        τ1 = N1 v1·n1 + ∂U1/∂θ1 + T1 lever1      T1 = rolled1 + L      lever_i = a − d_i − v_i·t_i
        τ2 = −N2 v2·n2 − ∂U2/∂θ2 − T2 lever2     T2 = rolled2 − L

    with n_i, t_i of each tip's face, ``rolled`` [N] the shears that rolling, the turning moments
    and the ``taper`` [rad] cause without a load (:func:`hand.grasp_state.holding_levers`), and N
    and ∂U/∂θ as the shears bend them. Between parallel faces ±v_i·n is arm_i and lever_i is W
    turn_i; ``motion`` is what :func:`hand.grasp_state.held_motion` gives. An error of both torques
    by e makes one of e/lever in L [m]. Zeros without two contacts.
    """
    d1, d2 = d
    theta1, theta2 = theta
    if not (d1 > 0.0 and d2 > 0.0):
        return 0.0, 0.0
    arm1, arm2, turn1, turn2, _, width, across = motion
    # What rolls the object out along its bisector is no lever of each force: taken back here.
    lean = math.tan(0.5 * taper)
    share = 1.0 / (1.0 + lean * lean)
    lever1 = share * (across * turn1 - lean * arm1)
    lever2 = share * (across * turn2 - lean * arm2)
    arm1 = share * (arm1 + lean * across * turn1)
    arm2 = share * (arm2 + lean * across * turn2)
    least = _LEAST_SLOPE * (lever1 * lever1 + lever2 * lever2)
    if least <= 0.0:
        return 0.0, 0.0
    # A tip can't bear more shear than it is pressed with.
    most = 0.5 * (lookup(data1, d1, theta1)[0] + lookup(data2, d2, theta2)[0])
    load = slope = 0.0
    for _ in range(_STEPS):
        left1, slope1 = _unexplained(
            data1, d1, theta1, 1.0, rolled[0] + load, torques[0], arm1, lever1
        )
        left2, slope2 = _unexplained(
            data2, d2, theta2, -1.0, rolled[1] - load, torques[1], arm2, lever2
        )
        over = lever1 * left1 - lever2 * left2
        slope = max(lever1 * slope1 + lever2 * slope2, least)
        load = min(max(load + over / slope, -most), most)
    return load, slope / max(abs(lever1) + abs(lever2), 1e-3 * width)
