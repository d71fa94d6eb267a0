"""The angle at which stuck tips let a held object rest, and the spring that keeps it upright.

Two fingers that mirror each other hold an object of width W between parallel faces, both tips d
deep. Small motions that don't mirror are its angle φ and the fingers' lean δ = (q1 − q2)/2, with
ψ = φ + δ what each tip's tilt changes by and σ what its shear does. Let joint 1 have kδ less torque
than the mean of both, and joint 2 as much more: a virtual spring k between the fingers. Then, with
the force N of each tip, its law to first order T/N = ψ + 2σ/d, (∂U/∂θ)/N = cdψ + σ (c is 2/3 for
the paper's springs), and b = k/(N B) for pivots 2B apart,

    T = N (φ − bδ)                                       both fingers' forces are on one line
    W T = N ((W + 2(a − d))φ − 2ℓδ) + 2 ∂U/∂θ            the object's moments
    σ = (a − d + ℓ)δ − W(φ − φ0)/2                       rolling, from where the tips stuck

with ℓ = L sin q + e cos q. The last is an integral of the stick condition while d and q change, so
that the way there doesn't matter. It follows, for an object that was at φ0 when the tips met it,

    φ/φ0 = W D/(W D − 4 (a − d + cd) M)
    D = 2ℓ + (1 − 2c)d − b(W − d)        M = a − d + ℓ + (1 + b)d/2

which vanishes with D: there is one spring with which the object stands upright whatever is stuck,
b = (2ℓ + (1 − 2c)d)/(W − d). Left out are the tilt q of the tips against the faces (of second
order), and all friction but the tips'.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel

_WIDTH_MIN = 0.1  # of the tip's radius, that W − d is not taken for less than


@inner_kernel
def upright_spring(
    q: float,
    d: float,
    force: float,
    turning: float,
    lengths: tuple[float, float, float, float],
) -> float:
    """Return the spring k [N·m/rad] between joints at ``q`` [rad] that keeps the object upright.

    ``d`` [m] and ``force`` [N] are the means of both tips, ``turning`` is their c; ``lengths`` [m]
    as in :func:`hand.grasp_state.held_motion`.
    """
    half_separation, length, offset, radius = lengths
    inward = length * math.sin(q) + offset * math.cos(q)
    width = 2.0 * (half_separation - inward - radius + d)
    gap = max(width - d, _WIDTH_MIN * radius)
    return force * half_separation * (2.0 * inward + (1.0 - 2.0 * turning) * d) / gap
