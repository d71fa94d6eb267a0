"""Integrate the simulated hand: two joints, two soft tips and one rigid object.

The integrator is the two-stage Rosenbrock method ROS2 with γ = 1 − 1/√2 and fixed sub-steps h. The
integrator advances the coordinates (q1, q2, x, y, φ), their velocities, the contact shears and the
motor currents:

    (1 − γhA) k1 = f(y)    (1 − γhA) k2 = f(y + h k1) − 2 k1    y ← y + h (3 k1 + k2)/2

The method is second-order accurate for any matrix A, and L-stable if A is the Jacobian. Here, A
contains only the stiff terms, which describe contact stiffness, contact damping, end stops, gear
bristles, motor lag and servo loops. Table friction enters A as a secant. Only the five
accelerations are coupled, so a step requires one 5 × 5 factorisation. The contact forces of the
tips are evaluated twice per step. To model Coulomb slip, shears and bristles are limited at the
start of each step. At the end of each step, the energy guard checks the energy.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.energy_guard import (
    HALVINGS,
    allow_changed_energy,
    allow_relaxed_energy,
    guard_step,
    is_on_rim,
    is_within_limit,
    open_guard,
    shorten,
)
from softfinger.daemon.simulation.physics.forces import (
    ELECTRIC_TIME,
    current_reference,
    evaluate_hand,
    evaluate_state,
    joint_stiffness,
    script_x,
    set_motor_slopes,
)
from softfinger.daemon.simulation.physics.plant_state import (
    ALONG_D,
    ALONG_SHEAR,
    ALONG_THETA,
    CORNERS,
    EXTRA_ROWS,
    LAYERS,
    NO_OBJECT,
    SHEARS,
    ExtraRow,
    FloatArray,
    Motion,
    Plant,
    Sample,
    Stage,
)
from softfinger.daemon.simulation.physics.tip import along_row, relax_shears, relax_tips
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.contact.table_record import Table

_GAMMA = 1.0 - math.sqrt(0.5)


# --- linear equations of a step, with g = γh -----------------------------------------------------


@inner_kernel
def factorise(plant: Plant, g: float) -> None:
    """Factorise the first-stage matrix M + gD + g²K for the five coordinates as L D Lᵀ.

    The matrix always includes the contacts between the tips and the object. Palm contacts and
    tip-to-tip contacts add extra rows.
    """
    p = plant.parameters
    full = plant.factors
    for i in range(5):
        for j in range(5):
            full[i, j] = 0.0
    for j in range(2):
        motor = plant.motor_by_rate[j] + g * plant.motor_by_q[j]
        full[j, j] = p.joint_inertia + g * (plant.drag[j] + g * (joint_stiffness(plant, j) + motor))
    full[2, 2] = p.mass + g * plant.drag[2]
    full[3, 3] = p.mass + g * plant.drag[3]
    full[4, 4] = p.inertia + g * plant.drag[4]
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        for r in range(3):
            weight = g * (tip.damping[r] + g * tip.stiffness[r])
            if weight == 0.0:
                continue
            for i in range(5):
                by = weight * tip.rows[r, i]
                for j in range(5):
                    full[i, j] += by * tip.rows[r, j]
    for number in range(EXTRA_ROWS if plant.has_extra_rows else 0):
        extra = plant.extra[number]
        weight = g * (extra.damping + g * extra.stiffness)
        if weight == 0.0:
            continue
        for i in range(5):
            by = weight * extra.row[i]
            for j in range(5):
                full[i, j] += by * extra.row[j]
    for k in range(5):
        if p.joints_held if k < 2 else p.object_held:
            for j in range(5):
                full[k, j] = 0.0
                full[j, k] = 0.0
            continue
        pivot = full[k, k]
        for i in range(k + 1, 5):
            ratio = full[i, k] / pivot
            for j in range(k + 1, 5):
                full[i, j] -= ratio * full[k, j]
            full[i, k] = ratio
        full[k, k] = 1.0 / pivot


@inner_kernel
def solve(plant: Plant, k: Motion) -> None:
    """Solve the step equations for the velocities in ``k``, which are 0 for fixed bodies."""
    full, out = plant.factors, k.velocity
    for i in range(5):
        value = plant.load[i]
        for j in range(i):
            value -= full[i, j] * out[j]
        out[i] = value
    for i in range(5):
        out[i] *= full[i, i]
    for i in range(4, -1, -1):
        for j in range(i + 1, 5):
            out[i] -= full[j, i] * out[j]


@inner_kernel
def take_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Subtract g K r from the load. K is the first-stage stiffness; r are the rates in ``k``."""
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        rows, stiffness = tip.rows, tip.stiffness
        by_d = g * stiffness[ALONG_D] * along_row(tip, ALONG_D, k.position)
        by_r = g * stiffness[ALONG_THETA] * along_row(tip, ALONG_THETA, k.position)
        by_t = g * stiffness[ALONG_SHEAR] * k.shear[finger]
        for j in range(5):
            plant.load[j] -= (
                rows[ALONG_D, j] * by_d + rows[ALONG_THETA, j] * by_r + rows[ALONG_SHEAR, j] * by_t
            )


@inner_kernel
def along_extra(extra: ExtraRow, rates: FloatArray) -> float:
    """Return the scalar product of an extra row and the ``rates`` of the coordinates."""
    rate: float = 0.0
    for j in range(5):
        rate += extra.row[j] * rates[j]
    return rate


@inner_kernel
def take_extra_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Subtract the extra rows' g K r from the load; r are the rates in ``k``."""
    for number in range(EXTRA_ROWS if plant.has_extra_rows else 0):
        extra = plant.extra[number]
        if extra.stiffness == 0.0:
            continue
        shear = extra.shear
        rate = k.extra_shear[shear - 1] if shear > 0 else along_extra(extra, k.position)
        by = g * extra.stiffness * rate
        for j in range(5):
            plant.load[j] -= by * extra.row[j]


# --- stages of a step ----------------------------------------------------------------------------


@inner_kernel
def begin_stage(
    plant: Plant, now: Motion, stage: Stage, earlier: Motion, k: Motion, g: float
) -> None:
    """Set the load and the rates in ``k`` at zero acceleration.

    ``now`` and ``stage`` contain the state and the contacts. ``earlier`` contains k1 in the second
    stage, and zeros in the first stage. A current i lags behind its reference r according to i' =
    (r(q, ω) − i)/τ. Per unit of acceleration, the rate of the current decreases by (r_q g + r_ω)
    g/(τ + g). The step matrix contains this decrease.
    """
    p, lag = plant.parameters, ELECTRIC_TIME
    for j in range(5):
        inertia = p.joint_inertia if j < 2 else p.mass if j < 4 else p.inertia
        plant.load[j] = plant.forces[j] - 2.0 * inertia * earlier.velocity[j]
        k.position[j] = now.velocity[j] - 2.0 * earlier.position[j]
    for j in range(SHEARS):
        rate = stage.extra_rate[j] - 2.0 * earlier.extra_shear[j]
        k.extra_shear[j] = rate if plant.has_extra_rows else 0.0
    for j in range(2):
        k.shear[j] = stage.on_object[j].shear_rate - 2.0 * earlier.shear[j]
        reference = current_reference(plant, j, now.position[j], now.velocity[j])
        displacement = k.position[j]
        fall = g * plant.motor_by_q[j] * displacement / p.torque_constant
        change = (reference - now.current[j] - 2.0 * lag * earlier.current[j]) / (lag + g) - fall
        k.current[j] = change
        torque = p.torque_constant * (now.current[j] + g * change)
        plant.load[j] += torque - g * joint_stiffness(plant, j) * displacement


@inner_kernel
def finish_stage(plant: Plant, k: Motion, g: float) -> None:
    """Solve for the velocities in ``k``, and update the other rates with these velocities."""
    solve(plant, k)
    for number in range(EXTRA_ROWS if plant.has_extra_rows else 0):
        extra = plant.extra[number]
        if extra.shear > 0 and extra.stiffness != 0.0:
            k.extra_shear[extra.shear - 1] += g * along_extra(extra, k.velocity)
    for j in range(5):
        k.position[j] += g * k.velocity[j]
    for j in range(2):
        tip = plant.stages[0].on_object[j]
        k.shear[j] += g * along_row(tip, ALONG_SHEAR, k.velocity)
        slope = plant.motor_by_rate[j] + g * plant.motor_by_q[j]
        k.current[j] -= g * slope / plant.parameters.torque_constant * k.velocity[j]


@inner_kernel
def begin_second_stage(plant: Plant, h: float) -> None:
    """Set the state of the second stage to y + h k1."""
    state, k, later = plant.state, plant.first, plant.stage_state
    for j in range(5):
        later.position[j] = state.position[j] + h * k.position[j]
        later.velocity[j] = state.velocity[j] + h * k.velocity[j]
    for j in range(2):
        later.shear[j] = state.shear[j] + h * k.shear[j]
        later.bristles[j] = state.bristles[j] + h * k.position[j]
        later.current[j] = state.current[j] + h * k.current[j]
    for j in range(SHEARS):
        later.extra_shear[j] = state.extra_shear[j] + h * k.extra_shear[j]


@inner_kernel
def bounded(value: float, limit: float) -> float:
    """Clip ``value`` to ± ``limit``."""
    return min(max(value, -limit), limit)


@inner_kernel
def advance_state(plant: Plant, h: float) -> None:
    """Advance the state to y + h (3 k1 + k2)/2, except for bodies that are held fixed."""
    p, state, first, second = plant.parameters, plant.state, plant.first, plant.second
    for j in range(2):
        state.shear[j] += h * (1.5 * first.shear[j] + 0.5 * second.shear[j])
        change = 1.5 * first.current[j] + 0.5 * second.current[j]
        state.current[j] = bounded(state.current[j] + h * change, 2.0 * p.stall_current)
    for j in range(SHEARS):
        state.extra_shear[j] += h * (1.5 * first.extra_shear[j] + 0.5 * second.extra_shear[j])
    for j in range(5):
        if p.joints_held if j < 2 else p.object_held:
            continue
        displacement = h * (1.5 * first.position[j] + 0.5 * second.position[j])
        change = h * (1.5 * first.velocity[j] + 0.5 * second.velocity[j])
        # Limit each displacement to a quarter of the tip radius per step. The limit can only remove
        # energy.
        limit = 0.25 * p.radius
        if j < 2:
            limit /= p.length + abs(p.offset)
        elif j == 4:
            limit /= p.extent
        displacement = bounded(displacement, limit)
        state.position[j] += displacement
        if j < 2:
            state.bristles[j] += displacement
        state.velocity[j] = bounded(state.velocity[j] + change, limit / h)


@inner_kernel
def limit_energy(plant: Plant, table: Table) -> None:
    """Halve a step until the energy is within the limit; undo the step after HALVINGS attempts."""
    for _ in range(HALVINGS):
        shorten(plant, 0.5)
        evaluate_state(plant, table)
        if is_within_limit(plant):
            return
    shorten(plant, 0.0)
    evaluate_state(plant, table)


@inner_kernel
def store_bristles(plant: Plant) -> None:
    """Store the limited bristle deflections and the friction level for the next step."""
    for joint in range(2):
        gears = plant.gears[joint]
        gears.level = gears.friction
        gears.deflection = gears.limited_deflection
        plant.state.bristles[joint] = gears.limited_deflection


# --- sampled tip contacts ------------------------------------------------------------------------


@inner_kernel
def senses_other_tip(plant: Plant, finger: int) -> bool:
    """Return True if a tip senses the other tip rather than the object."""
    if not plant.tips_may_touch:
        return False
    stage = plant.stages[0]
    stronger = stage.on_tip[finger].force > stage.on_object[finger].force
    return bool(plant.parameters.shape == NO_OBJECT or stronger)


@inner_kernel
def take_sample(plant: Plant, ring: Records[Sample]) -> None:
    """Interpolate between the previous and present contacts; write the sample to ``ring``."""
    p, stage = plant.parameters, plant.stages[0]
    due = plant.sample_count * p.sample_period
    back = min((plant.step_count * p.step - due) / p.step, 1.0)
    row = ring[plant.sample_count % len(ring)]
    row.number = plant.sample_count
    for finger in range(2):
        before = plant.sensed_contact[finger]
        on_other_tip = senses_other_tip(plant, finger)
        now = stage.on_tip[finger] if on_other_tip else stage.on_object[finger]
        # Do not interpolate between contacts with two different bodies.
        fraction = back if on_other_tip == (plant.on_other_tip[finger] != 0) else 0.0
        row.d[finger] = now.d - fraction * (now.d - before.d)
        row.theta[finger] = now.theta - fraction * (now.theta - before.theta)
        row.gain[finger] = now.gain - fraction * (now.gain - before.gain)
        row.relaxation_factor[finger] = 1.0 if on_other_tip else plant.relaxation_factor[finger]
        row.curvature[finger] = now.curvature
        row.tangential[finger] = now.tangential - fraction * (now.tangential - before.tangential)
    plant.sample_count += 1


@inner_kernel
def settle(plant: Plant, ring: Records[Sample]) -> None:
    """Take all samples that are due, and then store the present tip contacts."""
    p, stage = plant.parameters, plant.stages[0]
    while plant.sample_count * p.sample_period <= plant.step_count * p.step:
        take_sample(plant, ring)
    for finger in range(2):
        plant.state.shear[finger] = stage.on_object[finger].shear
        if plant.tips_may_touch:
            plant.state.extra_shear[CORNERS + finger] = stage.on_tip[finger].shear
        on_other_tip = senses_other_tip(plant, finger)
        now = stage.on_tip[finger] if on_other_tip else stage.on_object[finger]
        plant.sensed_contact[finger] = now
        plant.on_other_tip[finger] = on_other_tip


# --- the steps -----------------------------------------------------------------------------------


@kernel
def step(plants: Records[Plant], tables: Records[Table], ring: Records[Sample], count: int) -> None:
    """Advance the plant by ``count`` sub-steps and update the tip contacts.

    ``tables`` contains the contact table data. Due samples are written to ``ring``.
    """
    plant = plants[0]
    p, state = plant.parameters, plant.state
    # Each array argument costs a reference-count update per call. The other kernels therefore
    # receive a single record.
    data = tables[0]
    h = p.step
    g = _GAMMA * h
    scripted = p.object_held and p.script_speed > 0.0
    relaxing = p.creep > 0.0 or p.tip_micro_slip
    evaluate_state(plant, data)
    open_guard(plant)
    store_bristles(plant)
    settle(plant, ring)
    for _ in range(count):
        if scripted:
            t = plant.step_count * h
            state.velocity[2] = (script_x(plant, t + h) - script_x(plant, t)) / h
            evaluate_state(plant, data)
        plant.last_state = plant.state
        for finger in range(2):
            for k in range(LAYERS):
                plant.last_layers[finger, k] = plant.layers[finger, k]
        was_on_rim = is_on_rim(plant)
        set_motor_slopes(plant, g)
        factorise(plant, g)
        begin_stage(plant, state, plant.stages[0], plant.no_motion, plant.first, g)
        # A different order of the two sums in either stage would change the last bits of results.
        take_extra_stiffness(plant, plant.first, g)
        take_stiffness(plant, plant.first, g)
        finish_stage(plant, plant.first, g)
        begin_second_stage(plant, h)
        evaluate_hand(plant, data, plant.stage_state, plant.stages[1], False)
        begin_stage(plant, plant.stage_state, plant.stages[1], plant.first, plant.second, g)
        take_stiffness(plant, plant.second, g)
        take_extra_stiffness(plant, plant.second, g)
        finish_stage(plant, plant.second, g)
        advance_state(plant, h)
        plant.step_count += 1
        if scripted:
            state.position[2] = script_x(plant, plant.step_count * h)
        if relaxing:
            relax_shears(plant)
        # The evaluation limits the shears to model slip. `settle` stores the limited values.
        evaluate_state(plant, data)
        if scripted:
            open_guard(plant)
        else:
            changed = guard_step(plant, was_on_rim)
            if changed == 2:
                limit_energy(plant, data)
            elif changed == 1:
                # Slower gears have more friction and therefore more bristles. New bristles are
                # undeflected.
                store_bristles(plant)
                evaluate_state(plant, data)
            if changed != 0:
                allow_changed_energy(plant)
        store_bristles(plant)
        settle(plant, ring)
        if p.tips_relax:
            # The relaxation factor is constant within a step. Between steps, relaxation changes the
            # energy of the tip, and the guard accepts this change.
            relax_tips(plant)
            evaluate_state(plant, data)
            allow_relaxed_energy(plant)
