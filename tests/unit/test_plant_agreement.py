"""The plant against an adaptive solver of SciPy, and its order, in every kind of contact."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.harness import plant_reference as reference
from tests.harness.plant import LOSSLESS, hold_with, make, place

SECONDS = 0.02
RATES = (0.3, -0.2)
CORNERS = np.array([[-0.020, -0.030], [0.020, -0.030]])


@dataclass
class Scene:
    """A smooth motion: contacts neither made nor lost, tips and palm stick."""

    contacts: list
    simulation: dict = field(default_factory=dict)
    q: tuple = (0.18, 0.17)
    pose: tuple = (0.0005, 0.08, 0.02)
    velocity: tuple = (0.05, 0.05, 0.5)
    currents: tuple = (0.65, 0.68)
    corners: np.ndarray | None = None


SCENES = {
    "rectangle": Scene(reference.wedge(0.040)),
    "wedge": Scene(reference.wedge(0.040, 0.2), {"object_shape": "wedge", "object_taper": 0.2}),
    "disc": Scene(
        reference.disc(0.018), {"object_shape": "disc", "object_radius": 0.018}, q=(0.21, 0.20)
    ),
    "tips": Scene(
        reference.each_other(),
        {"object_shape": "none"},
        q=(0.46, 0.44),
        pose=(0.0, 0.08, 0.0),
        velocity=(0.0, 0.0, 0.0),
        currents=(0.50, 0.45),
    ),
    "palm": Scene(
        reference.wedge(0.040),
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
    """The state in the reference's order."""
    state = hand.plant.state
    shears = state.extra_shear[-2:] if scene.contacts[0].mutual else state.shear
    palm = state.extra_shear[: 0 if scene.corners is None else 2]
    return np.concatenate((state.position, state.velocity, shears, palm))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("loss", [0.002, 0.0])
def test_agreement_with_an_adaptive_solver_and_order_two(name, loss):
    scene = SCENES[name]
    hand = start(scene, loss, 10)
    p = hand.plant.parameters
    bodies = np.full(3, np.inf) if p.object_held else np.array([p.mass, p.mass, p.inertia])
    equations = reference.Equations(
        scene.contacts,
        np.array([p.joint_inertia, p.joint_inertia, *bodies]),
        np.array(scene.currents),
        loss,
        p.mass * p.gravity,
        scene.corners,
        0.05,
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
        assert hand.plant.guarded == 0  # smooth, so that the method alone is seen
        assert hand.d.min() > 0.001
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[2] < 1e-6
