"""Simulate soft tips in a MuJoCo scene, with this package's contact law and pressure grids.

:class:`SoftTips` turns spheres in any MuJoCo model into soft hemispheres. A passive-force callback
(`mjcb_passive`) applies friction and the force from the contact table. A user sensor returns the
pressure under each tip. :class:`MujocoHand` simulates the hand of a profile. The daemon uses
:class:`MujocoHand` if ``servos.backend = "mujoco"``.

The package's planar simulated hand uses the same contact law (`simulation.physics.tip`). In 3D, the
shear is a vector in the plane of the face. The component along the tilt is ζ = d_t. The square of
the component across the tilt is used as the variance v, because U contains ρ(ζ² + v). The forces f
are computed for the end of the step (docs/mujoco.md). The forces are linearly implicit in d, θ and
both shears. R contains the Jacobians of these four variables as rows:

    (1 + hBA) f = f(t) + h K w + h B R a     A = R M⁻¹ Rᵀ    B = D + h K    w = R q̇

K and D are the contact law's stiffness and damping, and h is the time step. The acceleration a is
due to all other forces in the last step. At rest, f equals the contact law's force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any, Self

import mujoco
import numpy as np
from pydantic import Field

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.factory import make_grid, make_material, make_table, make_tip
from softfinger.daemon.profile.fields import Section
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.physics.contacts import rim_on_plane
from softfinger.daemon.simulation.physics.forces import ELECTRIC_TIME, current_reference
from softfinger.daemon.simulation.physics.plant import settle
from softfinger.daemon.simulation.physics.plant_state import (
    FloatArray,
    FloatTriple,
    Parameters,
    Plant,
    Sample,
    TipContact,
)
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand, set_parameters
from softfinger.daemon.simulation.physics.tip import clear_contact, contact_forces
from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.contact.table_record import Table

__all__ = ["MujocoHand", "SoftTips"]

Work = tuple[FloatArray, FloatArray, FloatArray]

_ROWS = 4  # number of rows per tip: d, θ, and the shears along and across the tilt
_GAP_MAX = 0.005  # maximum gap that can close within the next step [m]
_VALUE_MIN = 1e-9  # negligible contact depth [m], friction force [N] and sin θ
_SHEAR = 2  # row index of the shear along the tilt
_UNSUPPORTED = (
    "tip_relaxation",
    "tip_micro_slip",
    "tip_creep_time",
    "joint_load_friction",
    "joint_stribeck",
)
# Impedance of joint friction. With MuJoCo's default impedance of 0.9, the joints creep at several
# mrad/s.
_IMPEDANCE = 0.9999


class Touch(Record):
    """Contact of one tip with a face in 3D; vectors are in world coordinates."""

    contact: TipContact
    normal: FloatTriple  # unit vector m from the tip's centre into the face
    along: FloatTriple  # unit vector t in the face, opposite to the tip axis's tilt
    across: FloatTriple  # m × t, the rotation axis of θ
    shear: FloatTriple  # displacement of the face relative to the tip [m]
    shear_across: float  # m


@inner_kernel
def _set_frame(touch: Touch, geometry: FloatArray) -> None:
    """Compute m, t, m × t and θ from the centre, axis and foremost point of a tip."""
    m, t, tip = touch.normal, touch.along, touch.contact
    m[:] = geometry[7:] - geometry[1:4]
    m /= math.sqrt((m * m).sum())
    tip.cosine = (m * geometry[4:7]).sum()
    t[:] = tip.cosine * m - geometry[4:7]
    tip.sine = math.sqrt((t * t).sum())
    tip.theta = math.atan2(tip.sine, tip.cosine)
    if tip.sine < _VALUE_MIN:
        least = np.argmin(np.abs(m))
        t[:] = -m[least] * m
        t[least] += 1.0
    t /= math.sqrt((t * t).sum())
    touch.across[:] = np.cross(m, t)


@inner_kernel
def _set_forces(p: Parameters, table: Table, touch: Touch, rate_across: float) -> float:
    """Evaluate the contact law for a 2D shear; return the damped force across the tilt."""
    tip = touch.contact
    stiffness = limit = 0.0
    for _ in range(2):
        tip.shear_variance = touch.shear_across**2
        contact_forces(p, table, tip, 1.0)
        stiffness = tip.stiffness[_SHEAR]
        limit = p.tip_friction * max(tip.normal, 0.0)
        total = math.hypot(tip.tangential, stiffness * touch.shear_across)
        if total <= limit * (1.0 + 1e-9):
            break
        # The tip slips, so scale both shear components to return the force to the friction cone.
        tip.shear += (limit / total - 1.0) * tip.tangential / stiffness
        touch.shear_across *= limit / total
    touch.shear[:] = tip.shear * touch.along + touch.shear_across * touch.across
    left = math.sqrt(max(limit * limit - tip.tangential**2, 0.0))
    force = stiffness * touch.shear_across + tip.damping[_SHEAR] * rate_across
    return float(min(max(force, -left), left))


@kernel
def press(
    touches: Records[Touch], parameters: Records[Parameters], tables: Records[Table],
    geometry: FloatArray, jacobians: FloatArray, velocity: FloatArray, dt: float, work: Work,
) -> None:  # fmt: skip
    """Evaluate all tips; store the rows R [4n, nv], the force along each row, and B in ``work``.

    ``geometry`` [n, 10] contains d, centre, axis and foremost point of each tip. ``jacobians`` [n,
    4, 3, nv] contains the position and rotation Jacobians of each tip, followed by those of the
    touched geom. ``dt`` [s] is the time since the last call.
    """
    p, data, rates = parameters[0], tables[0], np.zeros(_ROWS)
    rows, force, implicit = work
    rows[:] = force[:] = implicit[:] = 0.0
    for k in range(len(touches)):
        touch, of = touches[k], jacobians[k]
        tip, first = touch.contact, _ROWS * k
        tip.d = geometry[k, 0]
        tip.travel = rates[:] = 0.0
        if tip.d > -_GAP_MAX:
            _set_frame(touch, geometry[k])
            for i in range(3):
                slide = of[2, i] - of[0, i]
                rows[first] -= touch.normal[i] * slide
                rows[first + 1] += touch.across[i] * (of[3, i] - of[1, i])
                rows[first + 2] += touch.along[i] * slide
                rows[first + 3] += touch.across[i] * slide
            rates[:] = (rows[first : first + _ROWS] * velocity).sum(axis=1)
            tip.travel = max(p.step * rates[0], 0.0)
        if tip.d + tip.travel <= _VALUE_MIN:
            clear_contact(tip)
            touch.shear[:] = rows[first : first + _ROWS] = 0.0
            continue
        tip.rate_d, tip.rate_theta, tip.slip_rate = rates[0], rates[1], rates[2]
        # Rotate the shear into the current face without changing its length, then add the motion.
        along, across = (touch.shear * touch.along).sum(), (touch.shear * touch.across).sum()
        within = along * along + across * across
        scale = math.sqrt((touch.shear**2).sum() / within) if within > 0.0 else 0.0
        coupled = p.shear_coupling * math.tan(tip.theta)
        tip.shear = scale * along + dt * (rates[2] - coupled * rates[0])
        touch.shear_across = scale * across + dt * rates[3]
        rim_on_plane(p, tip)
        force[first + 3] = _set_forces(p, data, touch, rates[3])
        rates[2] = tip.shear_rate
        rows[first + 2] -= tip.tangent * rows[first]
        force[first : first + _ROWS - 1] = tip.along
        for i in range(_ROWS):
            row = min(i, _SHEAR)
            implicit[first + i] = tip.damping[row] + p.step * tip.stiffness[row]
            force[first + i] += p.step * tip.stiffness[row] * rates[i]


@kernel
def solve(
    touches: Records[Touch], parameters: Records[Parameters], work: Work, inertial: FloatArray,
    acceleration: FloatArray, passive: FloatArray, own: FloatArray,
) -> None:  # fmt: skip
    """Solve for the forces f at the end of the step.

    Add −Rᵀf to ``passive`` and write the acceleration −M⁻¹Rᵀf to ``own``. ``inertial`` is M⁻¹Rᵀ,
    stored as rows [4n, nv]. ``acceleration`` [nv] is the acceleration in the last step. Normal
    forces are clipped at 0, and friction forces are scaled onto the friction cone.
    """
    p = parameters[0]
    rows, force, implicit = work
    n = len(force)
    matrix = np.eye(n, n + 1)  # The last column is the right-hand side.
    for i in range(n):
        push = p.step * implicit[i] * rows[i]
        matrix[i, :n] += (push * inertial).sum(axis=1)
        matrix[i, n] = force[i] + (push * (acceleration - own)).sum()
    # Pivoting is unnecessary. All leading minors are positive, because B ≥ 0 is diagonal and A is
    # positive semidefinite.
    for i in range(n):
        matrix[i] /= matrix[i, i]
        for k in range(n):
            if k != i and matrix[k, i] != 0.0:
                matrix[k] -= matrix[k, i] * matrix[i]
    force[:] = matrix[:, n]
    for k in range(len(touches)):
        f, tangent = force[_ROWS * k : _ROWS * (k + 1)], touches[k].contact.tangent
        normal = max(f[0] - tangent * f[2], 0.0)
        f[2:] *= min(p.tip_friction * normal / max(math.hypot(f[2], f[3]), _VALUE_MIN), 1.0)
        f[0] = normal + tangent * f[2]
    passive -= (force.reshape(n, 1) * rows).sum(axis=0)
    own[:] = -(force.reshape(n, 1) * inertial).sum(axis=0)


class SoftTips:
    """Context manager that turns spheres in a MuJoCo model into soft tips.

    An active context uses MuJoCo's global callbacks ``mjcb_passive`` and ``mjcb_sensor``.
    Therefore, only one model at a time can have soft tips. A user sensor named ``TIP_pressure``
    with ``needstage="vel"`` receives the cell pressures [Pa]. The pressures are updated
    ``tactile.rate`` times per second.

    Parameters
    ----------
    model, data
        The MuJoCo scene.
    settings
        Settings for the tip, its material, the pressure grid and friction.
    tips
        Names of sphere geoms with the radius ``settings.tip.radius``. Each geom's z axis is the
        hemisphere's axis and points out of the finger.
    touching
        Names of the geoms that the tips can touch. Each tip contacts the nearest of these geoms,
        represented by its tangent plane. Disable MuJoCo's own collisions for these geoms and for
        the tips.
    table
        The tip's contact table. If None, the table is built from the settings.

    Raises
    ------
    SettingsError
        If the scene or the settings use an unsupported feature.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, settings: Settings,
        tips: Sequence[str] = ("left_tip", "right_tip"), touching: Sequence[str] = ("object",),
        table: ContactTable | None = None,
    ) -> None:  # fmt: skip
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise SettingsError("integrator: found RK4, expected Euler, implicit or implicitfast")
        simulation = settings.simulation
        if found := [name for name in _UNSUPPORTED if np.any(getattr(simulation, name))]:
            raise SettingsError(f"{found[0]}: not supported with MuJoCo")
        self._tips = [model.geom(name).id for name in tips]
        self._touching = [model.geom(name).id for name in touching]
        for name, geom in zip(tips, self._tips, strict=True):
            if abs(model.geom_size[geom, 0] - settings.tip.radius) > 1e-9:
                raise SettingsError(
                    f"{name}: expected a sphere of radius {settings.tip.radius:g} m"
                )
        self.model, self.data = model, data
        material = make_material(settings.material)
        self.table = make_table(settings, material) if table is None else table
        self._parameters = Parameters()
        set_parameters(self._parameters, settings, self.table, model.opt.timestep)
        n, nv = len(tips), model.nv
        self._all = np.zeros(n, Touch.dtype)
        self.touches = [Touch(self._all[k : k + 1]) for k in range(n)]
        self._geometry, self._jacobians = np.zeros((n, 10)), np.zeros((n, 4, 3, nv))
        self._work = np.zeros((_ROWS * n, nv)), np.zeros(_ROWS * n), np.zeros(_ROWS * n)
        self._inertial, self._own = np.zeros((_ROWS * n, nv)), np.zeros(nv)
        self._law, self._scale = (make_tip(settings), material), simulation.modulus_scale
        self._grids = [make_grid(settings, k % 2) for k in range(n)]
        self._sensors: list[tuple[int, FloatArray, FloatArray]] = []
        for k, name in enumerate(tips):
            with suppress(KeyError):  # The sensor is optional.
                cells = data.sensor(f"{name}_pressure").data.reshape(self._grids[k].shape)
                self._sensors.append((k, cells, np.zeros(cells.shape)))
        self._t, self._period, self._due = data.time, 1.0 / settings.tactile.rate, -math.inf

    def __enter__(self) -> Self:
        mujoco.set_mjcb_passive(self.add_forces)
        mujoco.set_mjcb_sensor(self.fill_sensors)
        return self

    def __exit__(self, *_: object) -> None:
        mujoco.set_mjcb_passive(None)
        mujoco.set_mjcb_sensor(None)

    def pressure(self, k: int, out: FloatArray | None = None) -> FloatArray:
        """Return tip ``k``'s cell pressures [Pa], float64 [rows, cols]."""
        touch, tip = self.touches[k], self.touches[k].contact
        frame = self.data.geom_xmat[self._tips[k]].reshape(3, 3)
        d = min(max(tip.d, 0.0), self._parameters.deepest)
        x, y = np.arcsin(np.clip(touch.normal @ frame[:, :2], -1.0, 1.0)).tolist()
        return self._grids[k].pressure(*self._law, d, x, y, self._scale * tip.gain, out)

    def add_forces(self, model: Any, data: Any) -> None:
        """Add the tip forces to ``qfrc_passive``. This method is the `mjcb_passive` callback."""
        if data is not self.data:
            return
        geometry, touching, fromto = self._geometry, self._touching, np.zeros(6)
        dt, self._t = data.time - self._t, data.time
        if dt < 0.0:  # The scene was reset.
            self._all["shear"] = self._own[:] = dt = 0.0
            self._due = -math.inf
        for k, tip in enumerate(self._tips):
            away = [mujoco.mj_geomDistance(model, data, tip, g, _GAP_MAX, None) for g in touching]
            touched = touching[away.index(min(away))]
            gap = mujoco.mj_geomDistance(model, data, tip, touched, _GAP_MAX, fromto)
            geometry[k, 0], geometry[k, 7:] = -gap, fromto[:3]
            geometry[k, 1:4], geometry[k, 4:7] = data.geom_xpos[tip], data.geom_xmat[tip, 2::3]
            for i, geom in ((0, tip), (2, touched)) if gap < _GAP_MAX else ():
                place, turn = self._jacobians[k, i : i + 2]
                mujoco.mj_jac(model, data, place, turn, fromto[3:], model.geom_bodyid[geom])
        law, work = (self._all, self._parameters.array), self._work
        press(*law, self.table.data, geometry, self._jacobians, data.qvel, dt, work)
        mujoco.mj_solveM(model, data, self._inertial, work[0])
        solve(*law, work, self._inertial, data.qacc, data.qfrc_passive, self._own)

    def fill_sensors(self, _: Any, data: Any, stage: int) -> None:
        """Write the pressure readings, which MuJoCo clears on each step (`mjcb_sensor`)."""
        if data is self.data and stage == mujoco.mjtStage.mjSTAGE_VEL:
            is_due = data.time >= self._due
            self._due = data.time + self._period - 1e-9 if is_due else self._due
            for k, cells, frame in self._sensors:
                cells[:] = self.pressure(k, frame) if is_due else frame


def hand_mjcf(settings: Settings, p: Parameters) -> str:
    """Return the MJCF model of the profile's hand and of a box in front of the hand.

    The hand moves in the xy plane, and z points towards the viewer. `set_parameters` computes the
    parameters ``p``. Raises SettingsError if the object is not a rectangle or the hand does not
    have two fingers.
    """
    shape, count = settings.simulation.object_shape, len(settings.scene.fingers)
    if shape != "rectangle" or count != 2:
        raise SettingsError(
            f"found a hand with {count} fingers and object_shape = {shape!r}, expected 2 fingers "
            "and object_shape = 'rectangle'"
        )
    fingers = sensors = ""
    for k, (name, side) in enumerate((("left", 1), ("right", -1))):
        end = f"{side * p.offset:.9g} {p.length:.9g} 0"
        # z is the hemisphere's axis. The sensor's x axis points away from the palm on the left
        # finger and towards the palm on the right finger. The y axis points towards the viewer.
        fingers += f"""
<body pos="{-side * p.half_separation:.9g} 0 0">
<joint name="{name}" axis="0 0 {-side}" range="{p.stop_low[k]:.9g} {p.stop_high[k]:.9g}"
 armature="{p.joint_inertia}" damping="{p.joint_damping}" frictionloss="{p.joint_friction}"
 solimpfriction="{_IMPEDANCE} {_IMPEDANCE}"/>
<geom type="capsule" size="{0.3 * p.radius:.9g}" fromto="0 0 0 {end}"/>
<geom name="{name}_tip" size="{p.radius:.9g}" pos="{end}" xyaxes="0 {side} 0 0 0 1"/>
</body>"""
        cells = settings.tactile.rows * settings.tactile.cols
        sensors += f'<user name="{name}_tip_pressure" dim="{cells}" needstage="vel"/>'
    x, y = settings.simulation.object_position
    width, height = settings.simulation.object_width, settings.simulation.object_height
    return f"""<mujoco model="softfinger"><compiler angle="radian" boundmass="1e-6"
 boundinertia="1e-9"/>
<option timestep="{p.step}" integrator="implicitfast" gravity="{p.gravity[0]} {p.gravity[1]} 0"/>
<default><geom contype="0" conaffinity="0" mass="0"/><general dyntype="filterexact"
 dynprm="{ELECTRIC_TIME}" gainprm="{p.torque_constant}" actearly="true"/></default>
<worldbody>{fingers}
<body pos="{x:.9g} {y:.9g} 0">
<joint name="x" type="slide" axis="1 0 0" ref="{x:.9g}" frictionloss="{p.table_force:.9g}"/>
<joint name="y" type="slide" axis="0 1 0" ref="{y:.9g}" frictionloss="{p.table_force:.9g}"/>
<joint name="angle" axis="0 0 1" frictionloss="{p.table_torque:.9g}"/>
<inertial pos="0 0 0" mass="{p.mass}" diaginertia="{p.inertia} {p.inertia} {p.inertia}"/>
<geom name="object" type="box" size="{0.5 * width:.9g} {0.5 * height:.9g} 0.03"/>
</body></worldbody>
<actuator><general joint="left"/><general joint="right"/></actuator>
<sensor>{sensors}</sensor></mujoco>"""


@kernel
def set_currents(plants: Records[Plant], control: FloatArray) -> None:
    """Set the current references [A] of both servos; the motor currents follow with a lag."""
    state = plants[0].state
    for j in range(2):
        control[j] = current_reference(plants[0], j, state.position[j], state.velocity[j])


@kernel
def feel(plants: Records[Plant], touches: Records[Touch], ring: Records[Sample]) -> None:
    """Copy the tip contacts from MuJoCo to the plant, and record the samples that are due."""
    plant = plants[0]
    for k in range(2):
        plant.stages[0].on_object[k] = touches[k].contact
        tip = plant.stages[0].on_object[k]
        if touches[k].across[2] < 0.0:  # The planar plant uses signed θ, shear and force.
            tip.theta, tip.sine = -tip.theta, -tip.sine
            tip.tangential, tip.shear = -tip.tangential, -tip.shear
    settle(plant, ring)


class Options(Section):
    """Settings in the profile table ``[plugins.mujoco]``."""

    timestep: Annotated[float, Field(ge=1e-4, le=0.002)] = 0.001  # MuJoCo's time step [s]


class MujocoHand(SimulatedHand):
    """Simulated hand with MuJoCo mechanics and the standard motor model.

    The energy of the plant is always 0.
    """

    def __init__(
        self, settings: Settings, start: float = 0.0, table: ContactTable | None = None
    ) -> None:
        """Build the scene at rest. Raises SettingsError if the settings are not supported."""
        step = Options.model_validate(settings.plugins.tables.get("mujoco", {})).timestep
        table = table or make_table(settings)
        parameters = Parameters()
        set_parameters(parameters, settings, table, step)
        self.model = mujoco.MjModel.from_xml_string(hand_mjcf(settings, parameters))
        self.data = mujoco.MjData(self.model)
        self.tips = SoftTips(self.model, self.data, settings, table=table)
        super().__init__(settings, start, table, step)

    def _run(self, count: int) -> None:
        plant, data, state = self.plant, self.data, self.plant.state
        data.qpos[:], data.qvel[:], data.act[:] = state.position, state.velocity, state.current
        with self.tips:
            if count == 0:
                mujoco.mj_step1(self.model, data)
                feel(plant.array, self.tips._all, self._ring)
            for _ in range(count):
                set_currents(plant.array, data.ctrl)
                data.qfrc_applied[2:] = plant.goals.load
                mujoco.mj_step2(self.model, data)
                mujoco.mj_step1(self.model, data)  # Compute the contacts that `feel` reads.
                state.position[:], state.velocity[:] = data.qpos, data.qvel
                state.current[:] = data.act
                plant.step_count += 1
                feel(plant.array, self.tips._all, self._ring)


class MujocoServos(SimulatedServos):
    """Servo backend ``"mujoco"``: simulated servos on the joints of :class:`MujocoHand`."""

    metal = False
    hand = MujocoHand
    Settings = Options

    def __init__(self, *scene: Any) -> None:
        super().__init__(*scene[:3])  # The last element contains the hand's options.
