"""Test the plant's motion and order of convergence against SciPy's adaptive solver.

The equations of motion are implemented independently, in plain NumPy. The equations assume a
constant modulus, sticking tips, and damping only in the tips and the palm. The contacts are
functions of the coordinates (q1, q2, x, y, φ), whose derivatives are computed by complex steps. The
forces are derived from the closed form of the tips' energy.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from softfinger.kinematics.hand.geometry import HandGeometry
from tests.harness.plant import CONSTANT, LOSSLESS, MODULUS, hold_with, make, place

HAND = HandGeometry()
PALM_STIFFNESS, PALM_LOSS = 1e5, 1e-3


def tips(x):
    """Return the centres of both tips for real or complex coordinates."""
    length, half = HAND.finger_length, HAND.half_separation
    return (
        np.array([-half + length * np.sin(x[0]), length * np.cos(x[0])]),
        np.array([half - length * np.sin(x[1]), length * np.cos(x[1])]),
    )


def turned(angle, vector):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def length_of(vector):
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2)


@dataclass
class Contact:
    """Contact of a tip with the object or another tip, given by functions of the coordinates x."""

    finger: int
    way: Callable  # maps x to the vector from the tip's centre to the point
    normal: Callable  # maps x to the unit vector into the touched body
    share: float = 1.0
    mutual: bool = False

    def variables(self, x):
        m = self.normal(x)
        d = HAND.tip_radius - (self.way(x) @ m)
        # The axes of the tips point at −q1 and π + q2.
        return np.array([d, np.arctan(m[1] / m[0]) + (x[0] if self.finger == 0 else -x[1])])

    def jacobian(self, x):
        columns = []
        for j in range(5):
            moved = x.astype(complex)
            moved[j] += 1e-30j
            columns.append(self.variables(moved).imag / 1e-30)
        return np.array(columns).T

    def slide(self, x):
        """Return the Jacobian row of the touched body's velocity along t relative to the tip."""
        m = self.normal(x)
        t = np.array([-m[1], m[0]])
        point = tips(x)[self.finger] + self.way(x)
        own = material(x, self.finger, point) @ np.eye(5)
        if self.mutual:
            touched = 0.5 * (own + material(x, 1 - self.finger, point))
        else:
            touched = np.zeros((2, 5))
            touched[:, 2:4] = np.eye(2)
            touched[:, 4] = [-(point[1] - x[3]), point[0] - x[2]]
        return t @ (touched - own)


def material(x, finger, point):
    """Return the Jacobian (2, 5) of the finger's material point at ``point``."""
    pivot = np.array([-HAND.half_separation, 0.0]) * (1 - 2 * finger)
    lever = point - pivot
    out = np.zeros((2, 5))
    out[:, finger] = np.array([-lever[1], lever[0]]) * (-1.0 if finger == 0 else 1.0)
    return out


def on_face(finger, point, angle):
    """Return the contact with a flat face through ``point`` with the inward normal at ``angle``."""

    def normal(x):
        return np.array([np.cos(x[4] + angle), np.sin(x[4] + angle)])

    def way(x):
        m = normal(x)
        reach = (np.array([x[2], x[3]]) + turned(x[4], point) - tips(x)[finger]) @ m
        return reach * m

    return Contact(finger, way, normal)


def wedge(width, taper=0.0, height=0.060):
    """Return the contacts with a wedge; ``width`` is the width at half height."""
    lean = 0.5 * taper
    slope = height * math.tan(lean)  # half the difference between the parallel sides
    middle = height * slope / (6.0 * width)
    return [
        on_face(0, np.array([-0.5 * width, middle]), -lean),
        on_face(1, np.array([0.5 * width, middle]), math.pi + lean),
    ]


def disc(radius):
    def contact(finger):
        def normal(x):
            away = np.array([x[2], x[3]]) - tips(x)[finger]
            return away / length_of(away)

        def way(x):
            return (length_of(np.array([x[2], x[3]]) - tips(x)[finger]) - radius) * normal(x)

        return Contact(finger, way, normal, math.sqrt(radius / (radius + HAND.tip_radius)))

    return [contact(0), contact(1)]


def each_other():
    def contact(finger):
        def way(x):
            return 0.5 * (tips(x)[1 - finger] - tips(x)[finger])

        def normal(x):
            return way(x) / length_of(way(x))

        return Contact(finger, way, normal, mutual=True)

    return [contact(0), contact(1)]


@dataclass
class Equations:
    """Equations of motion for five coordinates and for the shears of contacts and palm points."""

    contacts: list
    inertias: np.ndarray
    currents: np.ndarray
    loss: float
    weight: np.ndarray
    # Corners of an object that rests on a palm at y = ``palm``, in the object's frame.
    corners: np.ndarray | None = None
    palm: float = 0.0
    coupling: float = 1.0  # 1 if the shear depends on d and θ, 0 for bristles

    def __call__(self, _t, y):
        x, v = y[:5], y[5:10]
        shears = y[10:]
        forces = np.zeros(5)
        forces[:2] = CONSTANT * self.currents
        forces[2:4] = self.weight
        rates = []
        for contact, u in zip(self.contacts, shears, strict=False):
            d, theta = contact.variables(x)
            jacobian = contact.jacobian(x)
            cos, sin, tan = np.cos(theta), np.sin(theta), np.tan(theta)
            row = contact.slide(x) - self.coupling * tan * jacobian[0]
            k = math.pi * MODULUS * contact.share
            by_d = k * (d * d / cos**2 + self.coupling * 2 * d * u * tan + u * u)
            by_theta = k * (2 * d**3 * sin / (3 * cos**3) + self.coupling * d * d * u / cos**2)
            by_shear = k * (self.coupling * d * d * tan + 2 * d * u)
            by_d += self.loss * 2 * k * d / cos**2 * (jacobian[0] @ v)
            by_theta += self.loss * k * d**3 / (1.5 * cos**3) * (jacobian[1] @ v)
            by_shear += self.loss * 2 * k * d * (row @ v)
            forces -= jacobian[0] * by_d + jacobian[1] * by_theta + row * by_shear
            rates.append(row @ v)
        for k, corner in enumerate(() if self.corners is None else self.corners):
            lever = turned(x[4], corner)
            depth = self.palm - (x[3] + lever[1])
            if depth <= 0.0:
                rates.append(0.0)
                continue
            up = np.array([0.0, 0.0, 0.0, 1.0, lever[0]])
            along = np.array([0.0, 0.0, 1.0, 0.0, -lever[1]])
            push = PALM_STIFFNESS * (depth - PALM_LOSS * (up @ v))
            drag = PALM_STIFFNESS * (shears[len(self.contacts) + k] + PALM_LOSS * (along @ v))
            forces += max(push, 0.0) * up - drag * along
            rates.append(along @ v)
        return np.concatenate((v, forces / self.inertias, rates))


SECONDS = 0.02
RATES = (0.3, -0.2)
CORNERS = np.array([[-0.020, -0.030], [0.020, -0.030]])


@dataclass
class Scene:
    """Initial state and settings of a motion during which all contacts persist and stick."""

    contacts: list
    simulation: dict = field(default_factory=dict)
    q: tuple = (0.18, 0.17)
    pose: tuple = (0.0005, 0.08, 0.02)
    velocity: tuple = (0.05, 0.05, 0.5)
    currents: tuple = (0.65, 0.68)
    corners: np.ndarray | None = None
    coupling: float = 1.0


SCENES = {
    "rectangle": Scene(wedge(0.040)),
    "bristles": Scene(wedge(0.040), {"tip_law": "bristles"}, coupling=0.0),
    "wedge": Scene(wedge(0.040, 0.2), {"object_shape": "wedge", "object_taper": 0.2}),
    "disc": Scene(disc(0.018), {"object_shape": "disc", "object_radius": 0.018}, q=(0.21, 0.20)),
    "tips": Scene(
        each_other(),
        {"object_shape": "none"},
        q=(0.46, 0.44),
        pose=(0.0, 0.08, 0.0),
        velocity=(0.0, 0.0, 0.0),
        currents=(0.50, 0.45),
    ),
    "palm": Scene(
        wedge(0.040),
        {"palm": 0.05, "palm_friction": 50.0, "gravity": (0.0, -60.0), "object_mass": 0.5},
        pose=(0.0005, 0.07985, 0.0),
        velocity=(0.02, 0.0, 0.0),
        corners=CORNERS,
    ),
}


def start(scene: Scene, loss: float, count: int):
    hand = make(step=SECONDS / count, **{**LOSSLESS, "tip_loss": loss, **scene.simulation})
    hold_with(hand, np.array(scene.currents))
    place(hand, scene.q, scene.pose, RATES, scene.velocity)
    return hand


def compared(hand, scene: Scene) -> np.ndarray:
    """Return the state of the plant in the order of the reference's coordinates."""
    state = hand.plant.state
    shears = state.extra_shear[-2:] if scene.contacts[0].mutual else state.shear
    palm = state.extra_shear[: 0 if scene.corners is None else 2]
    return np.concatenate((state.position, state.velocity, shears, palm))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("loss", [0.002, 0.0])
def test_second_order_agreement_with_an_adaptive_solver(name, loss):
    scene = SCENES[name]
    hand = start(scene, loss, 10)
    p = hand.plant.parameters
    bodies = np.full(3, np.inf) if p.object_held else np.array([p.mass, p.mass, p.inertia])
    equations = Equations(
        scene.contacts,
        np.array([p.joint_inertia, p.joint_inertia, *bodies]),
        np.array(scene.currents),
        loss,
        p.mass * p.gravity,
        scene.corners,
        0.05,
        scene.coupling,
    )
    found = solve_ivp(
        equations,
        (0, SECONDS),
        compared(hand, scene),
        method="LSODA",
        rtol=1e-10,
        atol=1e-13,
    )
    exact = found.y[:, -1]
    scale = np.repeat([0.2, 0.08, 1.0, 0.001], [2, 3, 5, len(exact) - 10])
    errors = []
    for count in (240, 480, 20_000):
        hand = start(scene, loss, count)
        hand.advance(hand.t + SECONDS)
        errors.append(np.abs((compared(hand, scene) - exact) / scale).max())
        # The motion is smooth, so all errors are due to the integration method.
        assert hand.plant.limited_step_count == 0
        assert hand.d.min() > 0.001
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[2] < 1e-6
