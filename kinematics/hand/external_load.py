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

_LEAST_SLOPE = 0.1  # of what it is without a load


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
) -> tuple[float, float, float]:
    """What of side τ [N·m] one tip's N, ∂U/∂θ and T leave, and how fast it falls with T and T²."""
    contact = lookup(data, d, theta)
    force, _, force_d, force_theta, _, _, _ = contact
    by_d, by_theta = sheared_gradient(contact, d, theta, shear)
    sine = math.sin(theta)
    cosine = math.cos(theta)
    tangent = sine / cosine
    bend = 0.5 * (shear / force - sine) / cosine
    bend_t = 0.5 / (force * cosine)
    stretch_t = d * bend_t * (sine + 2.0 * cosine * bend)
    stretch_tt = d * bend_t * cosine * bend_t
    normal_t = force_d * stretch_t - 2.0 * force * cosine * bend * bend_t - tangent
    normal_tt = force_d * stretch_tt - force * cosine * bend_t * bend_t
    theta_t = force_theta * stretch_t + force * d * bend_t * (cosine - 2.0 * sine * bend)
    theta_tt = force_theta * stretch_tt - force * d * bend_t * sine * bend_t
    left = side * (torque - (by_d - shear * tangent) * arm) - by_theta - shear * lever
    return left, side * arm * normal_t + theta_t + lever, side * arm * normal_tt + theta_tt


@inner_kernel
def load_torques(
    data1: NDArray[float64],
    data2: NDArray[float64],
    d: Two,
    theta: Two,
    taper: float,
    motion: Motion,
    rolled: Two,
    torques: Two,
) -> tuple[float, float, float, float]:
    """(δ1, δ2, lever, bow): what of both torques [N·m] nothing but a load along t explains.

    Where each tip bears a share L [N] of a load 2 L along the object's t, both torques are

        τ1 = N1 v1·n1 + ∂U1/∂θ1 + T1 lever1      T1 = rolled1 + L      lever_i = a − d_i − v_i·t_i
        τ2 = −N2 v2·n2 − ∂U2/∂θ2 − T2 lever2     T2 = rolled2 − L

    with n_i, t_i of each tip's face, ``rolled`` [N] the shears that rolling, the turning moments
    and the ``taper`` [rad] cause without a load (:func:`hand.grasp_state.holding_levers`), and N
    and ∂U/∂θ as the shears bend them. Between parallel faces ±v_i·n is arm_i and lever_i is W
    turn_i; ``motion`` is what :func:`hand.grasp_state.held_motion` gives. δ_i is what is left of
    τ_i at L = 0; a load makes (δ1 + δ2)/2 = lever L + bow L², exactly. Zeros without two contacts,
    or where no load would show.
    """
    d1, d2 = d
    theta1, theta2 = theta
    if not (d1 > 0.0 and d2 > 0.0):
        return 0.0, 0.0, 0.0, 0.0
    arm1, arm2, turn1, turn2, _, _, across = motion
    # What rolls the object out along its bisector is no lever of each force: taken back here.
    lean = math.tan(0.5 * taper)
    share = 1.0 / (1.0 + lean * lean)
    lever1 = share * (across * turn1 - lean * arm1)
    lever2 = share * (across * turn2 - lean * arm2)
    arm1 = share * (arm1 + lean * across * turn1)
    arm2 = share * (arm2 + lean * across * turn2)
    left1, slope1, bow1 = _unexplained(data1, d1, theta1, 1.0, rolled[0], torques[0], arm1, lever1)
    left2, slope2, bow2 = _unexplained(data2, d2, theta2, -1.0, rolled[1], torques[1], arm2, lever2)
    lever = 0.5 * (slope1 + slope2)
    if lever <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return left1, -left2, lever, 0.5 * (bow1 - bow2)


@inner_kernel
def load_of(torque: float, lever: float, bow: float) -> tuple[float, float]:
    """(L, slope): the load [N] of a torque = lever L + bow L² [N·m], and the torque's slope [m].

    Beyond the parabola's end, to which no load leads, L goes on with the least slope.
    """
    least = _LEAST_SLOPE * lever
    slope = math.sqrt(max(lever * lever + 4.0 * bow * torque, least * least))
    return 2.0 * torque / (lever + slope), slope
