"""Compute the virtual joint spring that keeps a held object upright although the tips stick to it.

Two mirrored fingers hold an object of width W at its parallel faces. Each tip is displaced by d.
The small antisymmetric motions are the object's angle φ and the antisymmetric joint angle δ = (q1 −
q2)/2. Together, φ and δ change each tip's tilt by ψ = φ + δ and its shear by σ. A virtual spring k
between the fingers subtracts kδ from the torque of joint 1 and adds kδ to the torque of joint 2.
For a normal force N at each tip, the linearised tip model is T/N = ψ + 2σ/d and (∂U/∂θ)/N = cdψ +
σ. For the paper's spring model, c is 2/3. With b = k/(N B) and pivots 2B apart,

    T = N (φ − bδ)                                       the forces of both fingers are collinear
    W T = N ((W + 2(a − d))φ − 2ℓδ) + 2 ∂U/∂θ            moment balance of the object
    σ = (a − d + ℓ)δ − W(φ − φ0)/2                       rolling after the tips first stuck

where ℓ = L sin q + e cos q. The last equation is the stick condition, integrated over changes in d
and q. The result therefore does not depend on the path. For an object whose angle is φ0 at first
contact,

    φ/φ0 = W D/(W D − 4 (a − d + cd) M)
    D = 2ℓ + (1 − 2c)d − b(W − d)        M = a − d + ℓ + (1 + b)d/2

The angle φ vanishes for D = 0. The spring b = (2ℓ + (1 − 2c)d)/(W − d) therefore keeps the object
upright for any φ0. The model neglects all friction except at the tips, and the second-order effect
of the tip tilt q relative to the faces.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.hand.grasp_state import Lengths

_WIDTH_MIN = 0.1  # minimum of W − d, relative to the tip radius


@inner_kernel
def upright_spring(
    q: float, d: float, force: float, tilt_moment_ratio: float, lengths: Lengths
) -> float:
    """Return the joint spring k [N·m/rad] that keeps the object upright at joint angle ``q`` [rad].

    ``d`` [m] and ``force`` [N] are averages over both tips. ``tilt_moment_ratio`` is the constant
    c.
    """
    half_separation, length, offset, radius = lengths
    inward = length * math.sin(q) + offset * math.cos(q)
    width = 2.0 * (half_separation - inward - radius + d)
    gap = max(width - d, _WIDTH_MIN * radius)
    return force * half_separation * (2.0 * inward + (1.0 - 2.0 * tilt_moment_ratio) * d) / gap
