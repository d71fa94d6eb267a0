"""Test planar geometry against NumPy, and the motion of the held object against `Grasp`."""

import math

import numpy as np
import pytest

from softfinger import ContactTable, Fingertip, Material
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import (
    HeldMotion,
    Lengths,
    held_motion,
    holding_forces,
    load_of,
    load_torques,
    sheared_gradient,
    total_tilt,
)
from tests.harness.grasp import Grasp, GraspState, sheared_contact
from tests.harness.paper_tip import E
from tests.harness.plant import PAPER
from tests.harness.reference_hand import ReferenceHand

holding_forces = kernel(holding_forces.py_func)
sheared_gradient = kernel(sheared_gradient.py_func)
held_motion = kernel(held_motion.py_func)
load_of = kernel(load_of.py_func)
load_torques = kernel(load_torques.py_func)

HAND = ReferenceHand(finger_offset=0.003)
LENGTHS = Lengths(HAND.half_separation, HAND.finger_length, HAND.finger_offset, HAND.tip_radius)
WIDTH = 0.040


@pytest.fixture(scope="module", params=["constant", "table_i"])
def table(request: pytest.FixtureRequest) -> ContactTable:
    material = Material.constant(0.304e6) if request.param == "constant" else Material.table_i()
    return ContactTable.build(Fingertip(0.020), material)


@pytest.fixture(scope="module")
def grasp(table: ContactTable) -> Grasp:
    return Grasp(HAND, table, WIDTH)


def motion_of(state: GraspState) -> HeldMotion:
    c = HAND.contacts(state.q, state.pose, WIDTH)
    return held_motion(tuple(state.q), tuple(c.d), state.pose[2], 0.0, LENGTHS)


@pytest.mark.parametrize("delta", [0.0, 0.06, -0.12])
def test_moment_arms_are_the_equilibrium_torques_per_force(grasp, delta):
    state = grasp.symmetric(0.0035)
    if delta:
        state = grasp.steer(state, delta)
    c = HAND.contacts(state.q, state.pose, WIDTH)
    data = grasp.table.data
    found = holding_forces(data, data, tuple(c.d), tuple(c.theta), 0.0, motion_of(state))
    forces = grasp.forces(state)
    assert found.energy_arm == pytest.approx(forces.torque / forces.force.mean(), rel=5e-4)
    assert found.shear == pytest.approx(forces.tangential.mean(), rel=2e-3, abs=1e-8)
    assert found.normal == pytest.approx(forces.normal, rel=2e-3, abs=1e-8)


def faces(q, d, angle: float, taper: float):
    """Return the faces' normals and tangents, and the tips' centres, Jacobians and roll terms."""
    n, t = [], []
    for side in (-0.5, 0.5):
        at = angle + side * taper
        n.append(np.array([math.cos(at), math.sin(at)]))
        t.append(np.array([-math.sin(at), math.cos(at)]))
    tips, v = HAND.tips(q), HAND.tip_jacobian(q)
    rolls = [HAND.tip_radius - d[i] - v[i] @ t[i] for i in range(2)]
    return n, t, tips, v, rolls


@pytest.mark.parametrize("taper", [-0.4, 0.0, 0.2])
def test_a_tapered_object_satisfies_the_constraints_of_its_faces(taper):
    q, d, angle = (0.12, 0.21), (3e-3, 4e-3), -0.1
    n, t, tips, v, rolls = faces(q, d, angle, taper)
    a = HAND.tip_radius
    middle = tips.mean(axis=0)  # Any point can be the reference.
    w = [d[0] - a - n[0] @ (tips[0] - middle), d[1] - a + n[1] @ (tips[1] - middle)]
    s = [(tips[i] - middle) @ t[i] for i in range(2)]
    motion = held_motion(q, d, angle, taper, LENGTHS)
    for dq in ((1.0, 0.0), (0.0, 1.0), (0.3, -0.8)):
        # The unknowns are (Gx, Gy, φ). In the equations, d_t of each tip is constant, and d of both
        # tips changes by the same amount.
        left = np.array(
            [
                [*t[0], -w[0]],
                [*t[1], w[1]],
                [*(-n[0] - n[1]), s[0] + s[1]],
            ]
        )
        deeper = [n[0] @ v[0] * dq[0], -n[1] @ v[1] * dq[1]]
        right = [-rolls[0] * dq[0], -rolls[1] * dq[1], deeper[1] - deeper[0]]
        gx, gy, turned = np.linalg.solve(left, right)
        both = sum(deeper) + (n[1] - n[0]) @ [gx, gy] + (s[0] - s[1]) * turned
        r1, r2 = motion.rolling_ratio
        assert turned == pytest.approx(r1 * dq[0] - r2 * dq[1], rel=1e-12)
        found = motion.moment_arm @ np.array(dq) + motion.slide * turned
        assert found == pytest.approx(both, rel=1e-12, abs=1e-15)
    touched = [tips[0] + (a - d[0]) * n[0], tips[1] - (a - d[1]) * n[1]]
    along = np.array([math.cos(angle), math.sin(angle)])
    assert motion.width == pytest.approx((touched[1] - touched[0]) @ along, rel=1e-12)
    assert motion.across == pytest.approx(motion.width / math.cos(0.5 * taper), rel=1e-12)


@pytest.mark.parametrize("taper", [-0.4, 0.2])
def test_holding_forces_balance_a_tapered_object(grasp, taper):
    q, d, angle = (0.2, 0.16), (3.1e-3, 3e-3), 0.05
    n, t, tips, v, rolls = faces(q, d, angle, taper)
    a, data = HAND.tip_radius, grasp.table.data
    theta = (angle - 0.5 * taper + q[0], angle + 0.5 * taper - q[1])
    motion = held_motion(q, d, angle, taper, LENGTHS)
    held = holding_forces(data, data, d, theta, taper, motion)
    lean, mean = math.tan(0.5 * taper), held.shear
    normal = 0.5 * sum(held.normal)
    shear = (mean - lean * normal, mean + lean * normal)
    pressed = (normal + lean * mean, normal - lean * mean)
    looked_up = [lookup(data, d[i], theta[i]) for i in range(2)]
    felt = [sheared_gradient(looked_up[i], d[i], theta[i], shear[i]) for i in range(2)]
    for i, each in enumerate(held.normal):
        assert felt[i][0] - shear[i] * math.tan(theta[i]) == pytest.approx(each, rel=1e-4)
    # Sum the contact forces on the object, and the moments that the tips apply to the object.
    forces = [pressed[0] * n[0] - shear[0] * t[0], -pressed[1] * n[1] + shear[1] * t[1]]
    assert sum(forces) == pytest.approx([0.0, 0.0], abs=1e-12)
    touched = [tips[0] + (a - d[0]) * n[0], tips[1] - (a - d[1]) * n[1]]
    moments = [p[0] * f[1] - p[1] * f[0] for p, f in zip(touched, forces, strict=True)]
    turning = felt[0][1] + felt[1][1]
    assert sum(moments) == pytest.approx(turning, abs=5e-4 * normal * a)
    # The joint torque follows from the virtual work at each face.
    force = 0.5 * (looked_up[0][0] + looked_up[1][0])
    torque1 = pressed[0] * n[0] @ v[0] + shear[0] * rolls[0] + felt[0][1]
    torque2 = -pressed[1] * n[1] @ v[1] - shear[1] * rolls[1] - felt[1][1]
    assert held.energy_arm == pytest.approx((torque1 / force, torque2 / force), rel=1e-4)


def test_each_tip_has_its_own_table(grasp):
    soft = grasp.table.data
    stiff = ContactTable.build(Fingertip(0.020), Material.constant(0.6e6)).data
    q1, q2, d1, d2, angle = 0.14, 0.22, 4.0e-3, 2.6e-3, 0.03

    def held_by(left, right, q1, q2, d1, d2, angle):
        motion = held_motion((q1, q2), (d1, d2), angle, 0.2, LENGTHS)
        theta = angle - 0.1 + q1, angle + 0.1 - q2
        return holding_forces(left, right, (d1, d2), theta, 0.2, motion)

    here = held_by(soft, stiff, q1, q2, d1, d2, angle)
    mirrored = held_by(stiff, soft, q2, q1, d2, d1, -angle)
    assert here.energy_arm == pytest.approx(mirrored.energy_arm[::-1], rel=1e-12)
    assert here.shear == pytest.approx(-mirrored.shear, rel=1e-12)
    assert here.normal == pytest.approx(mirrored.normal[::-1], rel=1e-12)
    equal_tips = held_by(soft, soft, q1, q2, d1, d2, angle)
    assert here.energy_arm != pytest.approx(equal_tips.energy_arm, rel=1e-3)


def test_total_tilt_is_the_angle_between_normal_and_axis():
    assert total_tilt(0.3, 0.0) == pytest.approx(0.3)
    x, y = math.sin(0.2), math.sin(-0.1)
    assert math.cos(total_tilt(0.2, -0.1)) == pytest.approx(math.sqrt(1.0 - x * x - y * y))


# Load along the faces, computed from joint torques.


def found_load(
    table: ContactTable, state: GraspState, rolled: float, more: float = 0.0
) -> tuple[float, float]:
    c = HAND.contacts(state.q, state.pose, WIDTH)
    motion = motion_of(state)
    torque = Grasp(HAND, table, WIDTH).forces(state).torque + more
    data = table.data
    found = load_torques(
        data, data, tuple(c.d), tuple(c.theta), 0.0, motion, (rolled, rolled), tuple(torque)
    )
    return load_of(0.5 * sum(found.residual), found.arm, found.curvature)


@pytest.mark.parametrize("load", [0.0, 4.0, 8.0, -3.0, -6.0])
@pytest.mark.parametrize("delta", [0.0, 0.06, -0.12])
def test_load_from_torques_equals_the_load_on_the_tips(table, load, delta):
    state = Grasp(HAND, table, WIDTH).symmetric(0.0035)
    if delta:
        state = Grasp(HAND, table, WIDTH).steer(state, delta)
    along = load * np.array([-math.sin(state.pose[2]), math.cos(state.pose[2])])
    for k in range(1, 5):
        state = Grasp(HAND, table, WIDTH, weight=tuple(along * k / 4)).balance(state)
    shear = Grasp(HAND, table, WIDTH).forces(state).tangential
    rolled = 0.5 * (shear[0] + shear[1])
    found, slope = found_load(table, state, rolled)
    assert found == pytest.approx(0.5 * load, rel=0.02, abs=0.01)
    # The slope is the ratio of the torque error to the load error.
    more = 1e-5  # N·m
    again, _ = found_load(table, state, rolled, more)
    assert again - found == pytest.approx(more / slope, rel=0.02)


def test_moment_arms_and_load_are_zero_without_two_contacts(table):
    motion = held_motion((0.1, 0.1), (0.0, 1e-3), 0.0, 0.0, LENGTHS)
    data = table.data
    rolled = (0.0, 0.0)
    found = load_torques(data, data, (0.0, 1e-3), (0.1, -0.1), 0.0, motion, rolled, (0.5, 0.5))
    assert found == ((0.0, 0.0), 0.0, 0.0)
    held = holding_forces(data, data, (0.0, 1e-3), (0.1, -0.1), 0.0, motion)
    assert held == ((0.0, 0.0), 0.0, (0.0, 0.0))


def test_torques_that_no_load_explains_give_a_finite_load(table):
    for torque in (-50.0, 50.0):
        for q in np.linspace(-0.5, 1.0, 7):
            motion = held_motion((q, 0.1), (1e-6, 1e-3), 0.1, 0.3, LENGTHS)
            at = (table.data, table.data, (1e-6, 1e-3), (q, -0.1), 0.3, motion)
            found = load_torques(*at, (0.3, 0.3), (torque, 0.5))
            assert found.arm != 0.0  # Otherwise, the load would not affect the torques.
            load, slope = load_of(0.5 * sum(found.residual), found.arm, found.curvature)
            assert math.isfinite(load)
            assert slope > 0.0


@pytest.mark.parametrize("closing", [0.2, 0.34])  # The object is 28 or 7 mm wide.
@pytest.mark.parametrize("load", [0.0, 3.0])
@pytest.mark.parametrize("taper", [-0.3, 0.3])
def test_load_on_a_tapered_object_excludes_the_normal_forces_along_it(table, taper, load, closing):
    q, d, angle = (closing, closing), (3e-3, 3e-3), 0.0
    theta = (q[0] - 0.5 * taper, 0.5 * taper - q[1])
    data, lean = table.data, math.tan(0.5 * taper)
    motion = held_motion(q, d, angle, taper, LENGTHS)
    held = holding_forces(data, data, d, theta, taper, motion)
    out = 0.5 * lean * sum(held.normal)
    rolled = (held.shear - out, held.shear + out)
    # Compute the torques from the energies of both tips, each with its own shear.
    v, torques = HAND.tip_jacobian(q), []
    for i, shear in enumerate((rolled[0] + load, rolled[1] - load)):
        at = (i - 0.5) * taper
        n = np.array([math.cos(at), math.sin(at)])
        t = np.array([-n[1], n[0]])
        by_d, by_theta = sheared_gradient(lookup(data, d[i], theta[i]), d[i], theta[i], shear)
        normal = by_d - shear * math.tan(theta[i])
        torque = normal * n @ v[i] + shear * (HAND.tip_radius - d[i] - v[i] @ t) + by_theta
        torques.append(torque if i == 0 else -torque)
    model = load_torques(data, data, d, theta, taper, motion, rolled, tuple(torques))
    found, _ = load_of(0.5 * sum(model.residual), model.arm, model.curvature)
    assert found == pytest.approx(load, abs=2e-3)
    # The load must appear in the torques of both joints.
    assert model.residual[0] == pytest.approx(model.residual[1], abs=1e-9)


HANDS = [
    ReferenceHand(),
    ReferenceHand(pivot_separation=0.07, finger_length=0.06, finger_offset=0.012, tip_radius=0.012),
    ReferenceHand(finger_offset=-0.02),
]


def random_states(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(3)
    return [
        (
            generator.uniform(-0.4, 0.9, 2),
            generator.uniform([-0.02, 0.04, -0.5], [0.02, 0.1, 0.5]),
        )
        for _ in range(count)
    ]


def rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def contacts_by_rotation(hand: ReferenceHand, q, pose, width) -> np.ndarray:
    """Compute the contacts with rotated finger vectors and the object's rotation matrix."""
    local = np.array([hand.finger_offset, hand.finger_length])
    left = np.array([-hand.half_separation, 0]) + rotation(-q[0]) @ local
    right = np.array([hand.half_separation, 0]) + rotation(q[1]) @ (local * [-1, 1])
    in_object = [rotation(pose[2]).T @ (tip - pose[:2]) for tip in (left, right)]
    d1 = hand.tip_radius - (-width / 2 - in_object[0][0])
    d2 = hand.tip_radius - (in_object[1][0] - width / 2)
    return np.array([d1, d2, pose[2] + q[0], pose[2] - q[1], in_object[0][1], in_object[1][1]])


@pytest.mark.parametrize("hand", HANDS)
def test_contacts_and_jacobian_equal_those_from_rotation_matrices(hand):
    step = 1e-6 * np.eye(5)
    for q, pose in random_states(20):
        c = hand.contacts(q, pose, WIDTH)
        expected = contacts_by_rotation(hand, q, pose, WIDTH)
        np.testing.assert_allclose(np.concatenate((c.d, c.theta, c.s)), expected, atol=1e-15)
        x = np.concatenate((q, pose))
        ends = [
            [contacts_by_rotation(hand, at[:2], at[2:], WIDTH) for at in (x + h, x - h)]
            for h in step
        ]
        numeric = np.stack([(ahead - behind) / 2e-6 for ahead, behind in ends], axis=1)
        by_kind = hand.jacobian(x).swapaxes(0, 1).reshape(6, 5)
        np.testing.assert_allclose(by_kind, numeric, atol=1e-9)
        for finger, sense in ((0, 1.0), (1, -1.0)):
            inwards = sense * hand.tip_jacobian(q)[finger] @ [math.cos(pose[2]), math.sin(pose[2])]
            assert inwards == pytest.approx(numeric[finger, finger], abs=1e-9)


def test_sheared_energy_equals_closed_form_and_checkpoint():
    assert sheared_contact(PAPER, 0.006, math.radians(20), 0.0015)[0] == pytest.approx(
        0.10953644560057, rel=1e-12
    )
    generator = np.random.default_rng(1)
    for _ in range(100):
        d, theta = generator.uniform(1e-4, 0.010), generator.uniform(-0.5, 0.5)
        shear = generator.uniform(-0.5, 0.5) * d
        c, t = math.cos(theta), math.tan(theta)
        closed = math.pi * E * (d**3 / (3 * c**2) + d**2 * shear * t + d * shear**2)
        found = sheared_contact(PAPER, d, theta, shear)[0]
        assert found == pytest.approx(closed, rel=1e-11)


@pytest.mark.parametrize(
    ("d", "degrees", "normal", "moment"),
    [  # d [mm], q [°], N [N], N times its moment arm [mN·m], for L 80, B 50, W 40, e 0, a 20 mm
        (2, 8.6269265587, 3.8421597806, 303.895166),
        (4, 10.0786581078, 15.4013956785, 1213.098241),
        (8, 13.0028781629, 61.9376635610, 4827.960422),
    ],
)
def test_symmetric_grasp_values(d, degrees, normal, moment):
    grasp = Grasp(ReferenceHand(), PAPER, WIDTH)
    state = grasp.symmetric(d * 1e-3)
    forces = grasp.forces(state)
    np.testing.assert_allclose(np.degrees(state.q), degrees, rtol=1e-10)
    np.testing.assert_allclose(forces.normal, normal, rtol=1e-10)
    np.testing.assert_allclose(forces.tangential, 0, atol=1e-12)
    lever = 0.080 * np.cos(state.q)
    np.testing.assert_allclose(forces.normal * lever * 1e3, moment, rtol=1e-8)
    # The moment of the tilted tip contributes 0.1 to 0.4 % of each joint torque.
    turning = forces.turning * [1, -1]
    np.testing.assert_allclose(forces.torque, forces.normal * lever + turning, rtol=1e-12)
    np.testing.assert_allclose(grasp.gradient(state)[2:], 0, atol=1e-12)
