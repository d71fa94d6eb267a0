"""Compute the forces of a soft tip from d, θ and d_t, and relax tips and shears.

All elastic forces are derived from a single energy U, so a contact can't create energy:

    U = w(θ) κ [ U₀(d, θ) + F(d, θ) (sin θ d_t + s cos θ d_t²/d) ] + U_rim(d, θ)

The contact table contains the energy U₀ and the force F on a flat face. For a constant modulus E,
the force is F = πEd²/cos θ. For other materials, F contains the effective modulus of the material.
The factor s is ``tip_shear_stiffness``. For constant E and s = 1, the second term is πE(d² d_t tan
θ + d d_t²). This term is the tangential energy of the parallel-distributed model. The factor w(θ)
is 1 on the soft hemisphere and decreases to 0 towards the side of the finger. U_rim is the energy
of a stiff spring between the rim of the backing plate and the object. A plane reaches the rim at
the end of the soft range, d = a(1 − |sin θ|). The depth d = a(1 − √(sin² θ + 0.03²)) is slightly
before the rim. Beyond this depth, U₀ is linear in d, and F is constant.

These formulas are the contact law for ``simulation.tip_law = "springs"``. The law ``"bristles"``
omits the term sin θ d_t. The tangential force of the bristle law is T = 2 s F cos θ d_t/d. For a
constant E, T = 2πE s d d_t. A bristle at the centre of the contact exerts the tangential force.
Tilt and compression do not bend the bristle. The bristle's deflection d_t changes only when the
surfaces slide at the centre of the contact. The force at θ = 0, the normal force at d_t = 0 and the
sensor readings are the same for both laws. A controller that compensates for the tangential terms
of springs can be tested on a ``"bristles"`` tip, which lacks these terms.

A disc is a cylinder of radius R whose axis is normal to the hand plane. To leading order in d, a
contact with a disc differs in two ways from a contact with its tangent plane. First, the curvatures
add up to 1/a + 1/R, so the footprint is narrower along the tilt by the factor κ = √(R/(R + a)).
Second, at any θ, the force and energy are κ times the force and energy on the plane. Numerical
integrals over the springs confirm the factors for a constant modulus, a = 20 mm and d up to 8 mm.
For R = 20 and 40 mm, the error is at most 1.6 % at θ = 0 and 4.5 % at θ = 30°. For R = 10 mm, the
error is at most 3 % at θ = 0 and 9 % at θ = 30°. `sensor_model` computes the sensor frame directly
from the springs. Therefore, the sum of the frame's cells differs from the force by the error of the
factors. For small d, the force of a solid tip on a disc is proportional to √κ d^(3/2), as in
Hertz's theory for a sphere on a cylinder. The frame of a solid tip on a disc is √κ times the frame
of the tip on a plane.

Coulomb friction limits d_t to the range between the two shears at which |T| = μN. The ratio |T|/N
has a maximum, which is 1 for constant E, s = 1 and θ = 0. If the maximum of |T|/N is below μ, the
tip slips at this maximum. Damping is viscous and proportional to the stiffness of the soft part, so
damping increases as the contact grows.

Creep and micro-slip, which are off by default, relax the shear of a stuck tip. Without creep and
micro-slip, a tip sticks or slips as a whole and has no memory. Micro-slip occurs because each
spring has its own Coulomb friction. A spring of length ℓ(r) = √(a² − r²) that is compressed by w
exerts the pressure Ew/ℓ. When the face has moved sideways by u, the spring has the shear traction
Eu/ℓ. The spring slips if u > μw. All layers w = 0 … d are equally stiff, because r dr = −ℓ dℓ. For
a motion that starts at zero shear, integration gives

    T = 2πE ∫₀^d min(u, μw) dw = μN (1 − (1 − u/μd)²),   N = πEd²

The whole tip slips at u = μd. The layers form an Iwan model with uniformly distributed slip limits.
The layers scale with the footprint. The mean of the layer shears is the tip's d_t. In the tip
energy, the variance of the layer shears is added to d_t².
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import (
    ALONG_D,
    ALONG_SHEAR,
    ALONG_THETA,
    LAYERS,
    FloatArray,
    Parameters,
    Plant,
    TipContact,
)
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.contact.lookup import lookup_at, normal_at, stiffness_ahead
from softfinger.kinematics.contact.table_record import Table

D_MIN = 1e-9  # minimum d for a contact [m]
RIM_STIFFNESS = 1e6  # stiffness of the backing plate against the object [N/m]
_FADE_FROM = 1.15  # angle above which w(θ) decreases [rad]
_FADE_TO = 1.35  # angle at which w(θ) becomes 0 [rad]
_FRICTION_TOLERANCE = 5e-13  # relative tolerance for the friction limit
_RELAXATION_MIN = 0.02  # minimum relaxation factor, for tips with delayed recovery
# Distance from the end of the soft range to the rim at θ = 0, as a fraction of the tip radius.
_RIM_ROUNDING = 0.03


@inner_kernel
def fade(theta: float) -> tuple[float, float]:
    """Return w(θ) and dw/dθ."""
    u = (abs(theta) - _FADE_FROM) / (_FADE_TO - _FADE_FROM)
    if u <= 0.0:
        return 1.0, 0.0
    if u >= 1.0:
        return 0.0, 0.0
    slope = -6.0 * u * (1.0 - u) / (_FADE_TO - _FADE_FROM)
    return 1.0 - u * u * (3.0 - 2.0 * u), slope if theta > 0.0 else -slope


@inner_kernel
def shear_limit(t1: float, n0: float, n1: float, n2: float, friction: float) -> float:
    """Return the largest shear ζ ≥ 0 at which the tip does not slip.

    The tip sticks while t1 ζ ≤ μ (n0 + n1 ζ + n2 ζ²). If the tip sticks at every ζ, the function
    returns the ζ with the largest ratio |T|/N. The shear ζ is measured from the shear at which T =
    0.
    """
    if friction <= 0.0 or n0 <= 0.0:
        return 0.0
    b = t1 - friction * n1
    root = b * b - 4.0 * friction * friction * n0 * n2
    if b > 0.0 and root >= 0.0:
        return 2.0 * friction * n0 / (b + math.sqrt(root))
    return math.sqrt(n0 / n2)


@inner_kernel
def along_row(tip: TipContact, r: int, rates: FloatArray) -> float:
    """Return the scalar product of a tip's row ``r`` and the ``rates`` of the coordinates."""
    rate = 0.0
    for j in range(5):
        rate += tip.rows[r, j] * rates[j]
    return rate


@inner_kernel
def clear_contact(tip: TipContact) -> None:
    """Clear a tip's contact, but keep d, θ and the gain."""
    tip.force = 0.0
    tip.energy = 0.0
    tip.rim = 0.0
    tip.normal = 0.0
    tip.tangential = 0.0
    tip.shear = 0.0
    tip.shear_rate = 0.0
    tip.curvature = 0.0
    for r in range(3):
        tip.stiffness[r] = 0.0
        tip.damping[r] = 0.0
        for j in range(5):
            tip.rows[r, j] = 0.0


@inner_kernel
def contact_forces(p: Parameters, table: Table, tip: TipContact, factor: float) -> None:
    """Compute the forces, stiffness and damping of ``tip`` along d, θ and d_t.

    ζ is the shear d_t, and v is the variance of the layer shears. The factors are γ = ``gain`` =
    w(θ) κ, ρ = ``ratio`` = s cos θ/d, and χ = ``shear_coupling``, which is 1 for springs and 0 for
    bristles. Within the soft range:

        T = t0 + t1 ζ             t0 = χ γ F sin θ,  t1 = 2 γ F ρ
        N = n0 + n1 ζ + n2 ζ²     n0 = γ ∂U₀/∂d − χ t0 tan θ + ∂U_rim/∂d
                                  n1 = χ (γ ∂F/∂d sin θ − t1 tan θ),  n2 = γ ρ (∂F/∂d − F/d)
        U = γ (U₀ + F sheared) + U_rim     sheared = χ ζ sin θ + ρ (ζ² + v)
        |T| ≤ μ N limits ζ on both sides of ``neutral`` = −χ d tan θ/2s, where T = 0
        losses: loss · stiffness · rate    stiffness = γ/cos θ (∂F/∂d, 2d/3 ∂U₀/∂d) and t1

    ``factor`` is κ. ``tip`` must contain d, θ, travel, rates, slip rate, shear, shear variance and
    rim. The function sets all other fields except for the rows and the generalised forces.
    """
    d = tip.d
    sine = tip.sine
    cosine = tip.cosine
    shear = tip.shear
    shear_variance = tip.shear_variance
    gain, gain_theta = fade(tip.theta)
    gain *= factor
    gain_theta *= factor
    along_d = 0.0
    along_theta = 0.0
    energy = 0.0
    if tip.rim > 0.0:
        along_d = tip.rim_d
        along_theta = tip.rim_theta
        energy = tip.rim_energy
    force = 0.0
    normal = along_d
    tangential = 0.0
    leaning = 0.0
    tangent = 0.0
    stiffness_d = 0.0
    stiffness_theta = 0.0
    stiffness_t = 0.0
    ahead = 0.0  # largest possible increase in soft stiffness during this step
    if gain > 0.0:
        inverse_cosine = 1.0 / cosine
        leaning = sine * inverse_cosine
        tangent = p.shear_coupling * leaning
        ahead = stiffness_ahead(table, 2.0 * math.pi * p.modulus * gain, tip.travel)
        ahead *= inverse_cosine
    if gain > 0.0 and d > D_MIN:
        # d_soft is the part of d within the soft range. The derivatives of d_soft are d_soft_d and
        # d_soft_theta.
        radius = p.radius
        d_soft = d
        d_soft_d = 1.0
        d_soft_theta = 0.0
        if d > radius * (1.0 - _RIM_ROUNDING - abs(sine)):
            bent = math.sqrt(sine * sine + _RIM_ROUNDING * _RIM_ROUNDING)
            limit = radius * (1.0 - bent)
            if d > limit:
                d_soft = limit
                d_soft_d = 0.0
                d_soft_theta = -radius * sine * cosine / bent
        if d_soft > p.deepest:
            d_soft = p.deepest
            d_soft_d = 0.0
            d_soft_theta = 0.0
        force, soft, force_d, force_theta, _, soft_theta, _ = lookup_at(table, d_soft, tip.theta)
        slope, slope_d, slope_theta = normal_at(
            table, d_soft, tip.theta, (force, force_d, force_theta), leaning, inverse_cosine
        )
        scale = p.modulus_scale
        force *= scale
        force_d *= scale
        force_theta *= scale
        slope *= scale
        slope_d *= scale
        slope_theta *= scale
        # Beyond the soft range, extrapolate U₀ with its slope ∂U₀/∂d.
        inverse_d = 1.0 / d_soft
        over = d - d_soft
        soft = scale * soft + slope * over
        soft_theta = scale * soft_theta + (slope_theta + slope_d * d_soft_theta) * over

        # T and N are polynomials in the shear: T = t0 + t1 d_t, N = n0 + n1 d_t + n2 d_t².
        firm = p.tip_shear_stiffness
        ratio = firm * cosine * inverse_d
        coupled = p.shear_coupling * sine
        t0 = gain * force * coupled
        t1 = 2.0 * gain * force * ratio
        n0 = gain * slope - t0 * tangent + along_d
        n1 = gain * d_soft_d * force_d * coupled - t1 * tangent
        n2 = gain * d_soft_d * ratio * (force_d - force * inverse_d)
        curvature = max(n2, 0.25 * gain * force * ratio * inverse_d)
        neutral = -0.5 * tangent * d_soft / firm  # shear at which T = 0
        at_neutral = n0 + neutral * (n1 + neutral * n2)
        # Two comparisons detect contacts that are far from slipping, which is the usual case.
        normal = n0 + shear * (n1 + shear * n2)
        tangential = t0 + t1 * shear
        friction = p.tip_friction
        # The tolerance ensures that a limited shear is not limited a second time.
        stuck = friction * normal * (1.0 + _FRICTION_TOLERANCE)
        if abs(tangential) > stuck or curvature * (shear - neutral) ** 2 > at_neutral:
            slope_there = n1 + 2.0 * n2 * neutral
            highest = neutral + shear_limit(t1, at_neutral, slope_there, curvature, friction)
            lowest = neutral - shear_limit(t1, at_neutral, -slope_there, curvature, friction)
            shear = min(max(shear, lowest), highest)
            normal = n0 + shear * (n1 + shear * n2)
            tangential = t0 + t1 * shear
        normal += n2 * shear_variance

        # Compute the second term of U and the derivatives of this term.
        bent = firm * sine * inverse_d
        sheared = coupled * shear + ratio * shear * shear + ratio * shear_variance
        by_soft = force_d * sheared - force * ratio * inverse_d * shear * shear
        by_soft -= force * ratio * inverse_d * shear_variance
        by_theta = force_theta * sheared
        by_theta += force * shear * (p.shear_coupling * cosine - bent * shear)
        by_theta -= force * bent * shear_variance
        soft += force * sheared
        energy += gain * soft
        along_d += gain * (slope + d_soft_d * by_soft)
        along_theta += gain * (soft_theta + by_theta + d_soft_theta * by_soft) + gain_theta * soft
        stiffness_d = gain * force_d * inverse_cosine
        stiffness_theta = gain * slope * inverse_cosine * d_soft * (2.0 / 3.0)
        stiffness_t = t1
    else:
        shear = 0.0

    # Damping must not make a separating tip pull the object. Shear damping must not exceed the
    # friction force. The rate of d_t contains the spring model's term tan θ ḋ, which keeps the
    # virtual work consistent.
    rate_d = tip.rate_d
    rate_t = tip.slip_rate - tangent * rate_d
    loss = p.tip_loss
    loss_d = loss * stiffness_d
    if rate_d < 0.0:
        loss_d = min(loss_d, max(normal, 0.0) / -rate_d)
    loss_theta = loss * stiffness_theta
    loss_t = loss * stiffness_t
    if rate_t != 0.0:
        opposed = tangential if rate_t > 0.0 else -tangential
        loss_max = max(p.tip_friction * normal - opposed, 0.0)
        loss_t = min(loss_t, loss_max / abs(rate_t))
    tip.gain = gain
    tip.tangent = tangent
    tip.force = gain * force
    tip.energy = energy
    tip.normal = normal
    tip.tangential = tangential
    tip.shear = shear
    tip.shear_rate = rate_t if d > D_MIN else 0.0
    tip.stiffness[ALONG_D] = stiffness_d + ahead
    tip.stiffness[ALONG_THETA] = stiffness_theta
    tip.stiffness[ALONG_SHEAR] = stiffness_t
    if tip.rim + tip.travel > 0.0:
        # The rim may touch the object in this step. The gradient of the rim depth is at most the
        # gradient of d plus the radius times the gradient of θ. Therefore, doubling the rim
        # stiffness along d and θ gives an upper bound.
        tip.stiffness[ALONG_D] += 2.0 * RIM_STIFFNESS
        tip.stiffness[ALONG_THETA] += 2.0 * RIM_STIFFNESS * p.radius**2
    tip.damping[ALONG_D] = loss_d + loss * ahead
    tip.damping[ALONG_THETA] = loss_theta
    tip.damping[ALONG_SHEAR] = loss_t
    tip.along[ALONG_D] = along_d + loss_d * rate_d
    tip.along[ALONG_THETA] = along_theta + loss_theta * tip.rate_theta
    tip.along[ALONG_SHEAR] = tangential + loss_t * rate_t


@inner_kernel
def average_layers(plant: Plant, finger: int) -> float:
    """Return the mean shear of a tip's layers [m], and store the variance."""
    layers, mean, square = plant.layers[finger], 0.0, 0.0
    for k in range(LAYERS):  # Array expressions would load Numba's ufuncs at each startup.
        mean += layers[k] / LAYERS
    for k in range(LAYERS):
        square += (layers[k] - mean) ** 2
    plant.shear_variance[finger] = square / LAYERS
    return mean


@inner_kernel
def relax_shears(plant: Plant) -> None:
    """Relax the shears after a sub-step, based on the contacts at the start of the sub-step."""
    p, state = plant.parameters, plant.state
    for finger in range(2):
        tip, layers = plant.stages[0].on_object[finger], plant.layers[finger]
        stiffness = tip.stiffness[ALONG_SHEAR]
        if stiffness <= 0.0:
            for k in range(LAYERS):
                layers[k] = 0.0
            plant.shear_variance[finger] = 0.0
            continue
        neutral = tip.shear - tip.tangential / stiffness
        shear = state.shear[finger]
        shear += p.creep * (neutral - shear)
        if p.tip_micro_slip:
            limit = 2.0 * p.tip_friction * max(tip.normal, 0.0) / stiffness
            brought = shear - average_layers(plant, finger)
            for k in range(LAYERS):
                layer_limit = limit * (k + 0.5) / LAYERS
                layers[k] = neutral + min(
                    max(layers[k] + brought - neutral, -layer_limit), layer_limit
                )
            shear = average_layers(plant, finger)
        state.shear[finger] = shear


@inner_kernel
def relax_tips(plant: Plant) -> None:
    """Advance the relaxation of each tip by one sub-step, and set the tip's force factor ρ.

    All tip forces are multiplied by ρ = 1 + Σ r_i (1 − h_i/F∞), where F∞ is the long-term force.
    The states h_i satisfy ḣ_i = (F∞ − h_i)/τ_i. A suddenly loaded tip is initially stiffer by the
    factor 1 + Σ r_i. A suddenly unloaded tip recovers with a delay.
    """
    p = plant.parameters
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        lasting = tip.force / plant.relaxation_factor[finger]
        state = plant.relaxation_state[finger]
        factor = 1.0
        for k in range(3):
            state[k] += p.relaxation_step[k] * (lasting - state[k])
            if lasting > 0.0:
                factor += p.tip_relaxation[k] * (1.0 - state[k] / lasting)
            else:
                factor += p.tip_relaxation[k]
        plant.relaxation_factor[finger] = max(factor, _RELAXATION_MIN)
