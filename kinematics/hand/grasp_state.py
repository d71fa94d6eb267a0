"""Kernels for an object held by two rotational fingers: motion, holding torques and load.

:mod:`hand.geometry` defines the coordinates and signs. The kernels assume that the tips roll
without slipping and that the joints are at standstill. A pressure grid cannot measure shear, so the
load along the faces is estimated from the joint torques. First, the contributions of the normal
forces and of the tips' turning moments ∂U/∂θ are subtracted from the torques. The residual is the
shear force times its moment arm about the pivot.

The object's faces may form an angle α, the taper. The taper is positive if the object is wider at
the palm. The tilt is then θ = φ + q1 − α/2 at the left tip and θ = φ − q2 + α/2 at the right tip.
The bisector of the faces has the angle φ.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy import float64
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.table_record import LookupResult
from softfinger.kinematics.hand.geometry import tip_position, tip_velocity

FloatPair = tuple[float, float]  # (left, right)
_tip_position, _tip_velocity = inner_kernel(tip_position), inner_kernel(tip_velocity)
_SHEAR_STEPS = 3  # number of iterations for the shear forces; each one gains two digits


class Lengths(NamedTuple):
    """Dimensions of a hand [m]."""

    half_separation: float  # half the pivot separation
    finger: float
    offset: float  # fingertip offset
    radius: float  # tip radius


class HeldMotion(NamedTuple):
    """Jacobian and width of a held object; see :func:`held_motion`."""

    moment_arm: FloatPair  # ∂(d1 + d2)/∂q, the moment arms of the normal forces [m]
    shear_arm: FloatPair  # moment arms of the shear forces [m]
    rolling_ratio: FloatPair  # r1, r2 in φ̇ = r1 q̇1 − r2 q̇2
    slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    width: float  # distance between the contacts [m]
    across: float  # W in the equations; at least half the tip radius [m]


class HoldingForces(NamedTuple):
    """Moment arms and forces of an object held in equilibrium without a load."""

    energy_arm: FloatPair  # joint torque divided by the mean tip force [m]
    shear: float  # mean shear force T [N]
    normal: FloatPair  # N1, N2 [N]


class LoadModel(NamedTuple):
    """Residual joint torques, and the coefficients of the torque that a load L causes."""

    residual: FloatPair  # [N·m]
    arm: float  # [m]
    curvature: float  # [m/N]


@kernel
def total_tilt(tilt_x: float, tilt_y: float) -> float:
    """Return the angle θ between face normal and tip axis: sin² θ = sin² tilt_x + sin² tilt_y."""
    return math.asin(min(math.hypot(math.sin(tilt_x), math.sin(tilt_y)), 1.0))


@inner_kernel
def held_motion(
    q: FloatPair,
    d: FloatPair,
    angle: float,
    taper: float,
    lengths: Lengths,
) -> HeldMotion:
    """Return the Jacobian and the width of a held object.

    The vector v_i is the derivative of tip position i with respect to q_i. If the tips roll without
    slip and both displacements change by the same amount,

        φ̇ = r1 q̇1 − r2 q̇2      r_i = b_i/W      b_i = a − d_i − v_i·t/cos(α/2)
        ḋ1 + ḋ2 = arm1 q̇1 + arm2 q̇2 + slide φ̇
        arm_i = ±v_i·n/cos(α/2) − tan(α/2) (a − d_i)
        slide = (O1 − O2)·t/cos(α/2) + tan(α/2) (d1 − d2)

    where n and t are the normal and the tangent of the bisector at the ``angle`` φ, and α is the
    ``taper`` [rad]. The object moves along t as the tips roll and approach each other. For parallel
    faces, arm_i and b_i [m] are the moment arms of the normal force and of the shear force about
    the pivot. In a symmetric grasp, r1 + r2 equals 2 (a − d + L sin q + e cos q)/W. ``across`` is W
    = d1 + d2 − 2a + (O2 − O1)·n/cos(α/2) [m]. The distance between the contacts along n is
    ``width`` = W cos(α/2).

    W is clamped to at least half the tip radius, because the rotation and the shear forces would
    diverge for thinner objects. In reality, inertia and the shear compliance of the tips slow the
    rotation of thin objects.
    """
    q1, q2 = q
    d1, d2 = d
    half_separation, length, offset, radius = lengths
    nx = math.cos(angle)
    ny = math.sin(angle)
    face_slope = math.tan(0.5 * taper)
    longer = math.sqrt(1.0 + face_slope * face_slope)
    x1, y1 = _tip_position(q1, 1.0, half_separation, length, offset)
    x2, y2 = _tip_position(q2, -1.0, half_separation, length, offset)
    vx1, vy1 = _tip_velocity(q1, 1.0, length, offset)
    vx2, vy2 = _tip_velocity(q2, -1.0, length, offset)
    across = d1 + d2 - 2.0 * radius + longer * ((x2 - x1) * nx + (y2 - y1) * ny)
    bounded = max(across, 0.5 * radius)
    arm1 = longer * (vx1 * nx + vy1 * ny) - face_slope * (radius - d1)
    arm2 = -longer * (vx2 * nx + vy2 * ny) - face_slope * (radius - d2)
    shear_arm1 = radius - d1 - longer * (vy1 * nx - vx1 * ny)
    shear_arm2 = radius - d2 - longer * (vy2 * nx - vx2 * ny)
    return HeldMotion(
        (arm1, arm2),
        (shear_arm1, shear_arm2),
        (shear_arm1 / bounded, shear_arm2 / bounded),
        longer * ((y1 - y2) * nx - (x1 - x2) * ny) + face_slope * (d1 - d2),
        across / longer,
        bounded,
    )


@inner_kernel
def sheared_gradient(
    contact: LookupResult,
    d: float,
    theta: float,
    tangential: float,
) -> tuple[float, float]:
    """Return (∂U/∂d, ∂U/∂θ) of a tip under the shear force ``tangential`` [N].

    ``contact`` is the result of a table lookup at ``d`` and ``theta``.
    """
    force = contact.force
    sine = math.sin(theta)
    cosine = math.cos(theta)
    # Solve T = F (sin θ + 2 cos θ d_t/d) for the shear ratio d_t/d.
    shear_ratio = 0.5 * (tangential / force - sine) / cosine
    shear = shear_ratio * d
    depth_change = shear * (sine + cosine * shear_ratio)
    return (
        contact.energy_d
        + contact.force_d * depth_change
        - force * cosine * shear_ratio * shear_ratio,
        contact.energy_theta
        + contact.force_theta * depth_change
        + force * shear * (cosine - sine * shear_ratio),
    )


@inner_kernel
def holding_forces(
    data1: NDArray[float64],
    data2: NDArray[float64],
    d: FloatPair,
    theta: FloatPair,
    taper: float,
    motion: HeldMotion,
) -> HoldingForces:
    """Return the moment arms, the shear and the normal forces of an object held in equilibrium.

    The torques are the gradient of the energy along the rolling ``motion`` from
    :func:`held_motion`:

        τ1 = N arm1 + ∂U1/∂θ1 + T b1      τ2 = N arm2 − ∂U2/∂θ2 − T b2

    T is the mean shear force, and b_i are its moment arms. The moment equilibrium of the object
    requires T W = N slide + ∂U1/∂θ1 + ∂U2/∂θ2. Faces with a ``taper`` α [rad] push the object out.
    The shear force is therefore T − N tan(α/2) at the left tip and T + N tan(α/2) at the right tip.
    F is the mean contact force of both tips. A modulus that is common to both tips therefore
    cancels in the moment arms τ/F [m]. N is the mean of the normal forces N1 and N2 [N]. N1 and N2
    differ if the object rubs against its surroundings. ``data1`` and ``data2`` are the arrays of
    the contact tables. All results are zero unless both tips are in contact.
    """
    d1, d2 = d
    theta1, theta2 = theta
    if not (d1 > 0.0 and d2 > 0.0):
        return HoldingForces((0.0, 0.0), 0.0, (0.0, 0.0))
    arm1, arm2 = motion.moment_arm
    shear_arm1, shear_arm2 = motion.shear_arm
    contact1 = lookup(data1, d1, theta1)
    contact2 = lookup(data2, d2, theta2)
    tangential = normal = normal1 = normal2 = turning1 = turning2 = 0.0
    tangent1 = math.tan(theta1)
    tangent2 = math.tan(theta2)
    face_slope = math.tan(0.5 * taper)
    for _ in range(_SHEAR_STEPS):
        out = face_slope * normal
        by_d1, turning1 = sheared_gradient(contact1, d1, theta1, tangential - out)
        by_d2, turning2 = sheared_gradient(contact2, d2, theta2, tangential + out)
        normal1 = by_d1 - (tangential - out) * tangent1
        normal2 = by_d2 - (tangential + out) * tangent2
        normal = 0.5 * (normal1 + normal2)
        tangential = (normal * motion.slide + turning1 + turning2) / motion.across
    force = 0.5 * (contact1.force + contact2.force)
    torque1 = normal * arm1 + turning1 + tangential * shear_arm1
    torque2 = normal * arm2 - turning2 - tangential * shear_arm2
    return HoldingForces((torque1 / force, torque2 / force), tangential, (normal1, normal2))


_SLOPE_MIN = 0.1  # minimum slope, relative to the slope without a load


@inner_kernel
def _unexplained(
    data: NDArray[float64],
    d: float,
    theta: float,
    side: float,
    shear: float,
    torque: float,
    arm: float,
    shear_arm: float,
) -> tuple[float, float, float]:
    """Return the residual torque [N·m] of one finger, and its coefficients for −T and −T².

    The residual is the joint torque, signed by ``side``, minus the contributions of N, ∂U/∂θ and T.
    """
    contact = lookup(data, d, theta)
    force = contact.force
    by_d, by_theta = sheared_gradient(contact, d, theta, shear)
    sine = math.sin(theta)
    cosine = math.cos(theta)
    tangent = sine / cosine
    shear_ratio = 0.5 * (shear / force - sine) / cosine
    shear_ratio_t = 0.5 / (force * cosine)
    depth_change_t = d * shear_ratio_t * (sine + 2.0 * cosine * shear_ratio)
    depth_change_tt = d * shear_ratio_t * cosine * shear_ratio_t
    normal_t = (
        contact.force_d * depth_change_t
        - 2.0 * force * cosine * shear_ratio * shear_ratio_t
        - tangent
    )
    normal_tt = contact.force_d * depth_change_tt - force * cosine * shear_ratio_t * shear_ratio_t
    theta_t = contact.force_theta * depth_change_t + force * d * shear_ratio_t * (
        cosine - 2.0 * sine * shear_ratio
    )
    theta_tt = (
        contact.force_theta * depth_change_tt - force * d * shear_ratio_t * sine * shear_ratio_t
    )
    remaining = side * (torque - (by_d - shear * tangent) * arm) - by_theta - shear * shear_arm
    return (
        remaining,
        side * arm * normal_t + theta_t + shear_arm,
        side * arm * normal_tt + theta_tt,
    )


@inner_kernel
def load_torques(
    data1: NDArray[float64],
    data2: NDArray[float64],
    d: FloatPair,
    theta: FloatPair,
    taper: float,
    motion: HeldMotion,
    rolled: FloatPair,
    torques: FloatPair,
) -> LoadModel:
    """Return the residual torques and the load model of a held object.

    δ1 and δ2 [N·m] are the parts of the joint torques that only a load along the object's t axis
    can cause. If the total load is 2 L [N], half of it at each tip, the torques are

        τ1 = N1 v1·n1 + ∂U1/∂θ1 + T1 c1      T1 = rolled1 + L      c_i = a − d_i − v_i·t_i
        τ2 = −N2 v2·n2 − ∂U2/∂θ2 − T2 c2     T2 = rolled2 − L

    where n_i and t_i belong to the face at each tip. ``rolled`` [N] are the shear forces without a
    load, computed by :func:`holding_forces`. Without a load, rolling, the turning moments and
    the ``taper`` [rad] cause the shear forces. N and ∂U/∂θ include the effect of the shear forces.
    ``motion`` is the result of :func:`held_motion`. For parallel faces, ±v_i·n and c_i equal
    the moment arms in ``motion``.

    δ_i is the residual of τ_i at L = 0. A load causes exactly (δ1 + δ2)/2 = arm L + curvature L².
    All results are zero if a tip is not in contact or if a load would not change the torques.
    """
    d1, d2 = d
    theta1, theta2 = theta
    none = LoadModel((0.0, 0.0), 0.0, 0.0)
    if not (d1 > 0.0 and d2 > 0.0):
        return none
    arm1, arm2 = motion.moment_arm
    shear_arm1, shear_arm2 = motion.shear_arm
    # Remove the motion along the bisector, because it does not contribute to the moment arms.
    face_slope = math.tan(0.5 * taper)
    scale = 1.0 / (1.0 + face_slope * face_slope)
    normal_arm1 = scale * (arm1 + face_slope * shear_arm1)
    normal_arm2 = scale * (arm2 + face_slope * shear_arm2)
    shear_arm1 = scale * (shear_arm1 - face_slope * arm1)
    shear_arm2 = scale * (shear_arm2 - face_slope * arm2)
    remaining1, slope1, curvature1 = _unexplained(
        data1, d1, theta1, 1.0, rolled[0], torques[0], normal_arm1, shear_arm1
    )
    remaining2, slope2, curvature2 = _unexplained(
        data2, d2, theta2, -1.0, rolled[1], torques[1], normal_arm2, shear_arm2
    )
    moment_arm = 0.5 * (slope1 + slope2)
    if moment_arm <= 0.0:
        return none
    return LoadModel((remaining1, -remaining2), moment_arm, 0.5 * (curvature1 - curvature2))


@inner_kernel
def load_of(torque: float, moment_arm: float, curvature: float) -> tuple[float, float]:
    """Solve torque = moment_arm L + curvature L² [N·m]; return L [N] and the slope ∂torque/∂L [m].

    A load cannot cause a torque beyond the vertex of the parabola. The slope is clamped to a
    minimum.
    """
    slope_min = _SLOPE_MIN * moment_arm
    slope = math.sqrt(
        max(moment_arm * moment_arm + 4.0 * curvature * torque, slope_min * slope_min)
    )
    return 2.0 * torque / (moment_arm + slope), slope
