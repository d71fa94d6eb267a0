"""Test the shapes of the simulated object, contact between the tips, and the palm."""

import math

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.simulated_tactile import SimulatedTactile
from tests.harness.plant import (
    BOUNDED,
    PAPER,
    make,
    place,
    run,
    settled,
)
from tests.harness.reference_hand import ReferenceHand

RADIUS = 0.020
GRAVITY = 9.80665
HAND = ReferenceHand()


def shape(**simulation):
    return shape_of(Settings(simulation=SimulationSettings(**simulation)))


# Shapes.


def test_radius_of_gyration_and_mean_radius_of_the_shapes():
    square = shape(object_width=0.04, object_height=0.04)
    assert square.gyration == pytest.approx(0.04 / math.sqrt(6))
    # The mean radius is (√2 + asinh 1)/6 times the side.
    assert square.mean_radius == pytest.approx(0.04 * (math.sqrt(2) + math.asinh(1)) / 6, rel=1e-4)
    disc = shape(object_shape="disc", object_radius=0.03)
    assert (disc.gyration, disc.mean_radius) == pytest.approx((0.03 / math.sqrt(2), 0.02))
    flat = shape(object_shape="wedge", object_taper=0.0)
    np.testing.assert_allclose(flat.corners, shape().corners)
    assert flat.gyration == pytest.approx(shape().gyration)


def test_a_wedge_has_its_origin_at_the_centre_of_mass():
    wedge = shape(object_shape="wedge", object_taper=0.6)
    # The angle between the faces is 0.6 rad, and their distance at half the height is 40 mm.
    normals = wedge.edges()[:, 2:4]
    assert math.acos(-normals[1] @ normals[3]) == pytest.approx(0.6)
    np.testing.assert_allclose(normals[1], [math.cos(0.3), math.sin(0.3)])
    sides = wedge.corners[[0, 3]].mean(axis=0), wedge.corners[[1, 2]].mean(axis=0)
    assert sides[1][0] - sides[0][0] == pytest.approx(0.04)
    # Draw random points in the bounding box, and keep those inside the shape.
    generator = np.random.default_rng(1)
    low, high = wedge.corners.min(axis=0), wedge.corners.max(axis=0)
    points = generator.uniform(low, high, (400_000, 2))
    for edge in wedge.edges():
        points = points[(points - edge[:2]) @ edge[2:4] < 0]
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-4)
    distances = np.hypot(*points.T)
    assert wedge.mean_radius == pytest.approx(distances.mean(), rel=3e-3)
    assert wedge.gyration == pytest.approx(math.sqrt((distances**2).mean()), rel=3e-3)
    assert wedge.half_width == pytest.approx(0.02 - sides[0][1] * -math.tan(0.3), rel=1e-9)


def nearest_by_brute_force(corners, point):
    """Return the vector from ``point`` to the nearest of many sampled outline points."""
    share = np.linspace(0, 1, 20_001)[:, None]
    ends = np.roll(corners, -1, axis=0)
    outline = np.concatenate(
        [(1 - share) * p + share * q for p, q in zip(corners, ends, strict=True)]
    )
    away = outline - point
    return away[np.hypot(*away.T).argmin()]


def test_tips_touch_the_nearest_point_of_a_wedge():
    hand = make(object_shape="wedge", object_taper=0.5, object_height=0.03)
    corners = shape(object_shape="wedge", object_taper=0.5, object_height=0.03).corners
    kinds = set()
    for height in np.linspace(0.04, 0.12, 33):
        for angle in (-0.4, 0.0, 0.7, 2.5):
            place(hand, (0.15, 0.10), (0.0, height, angle))
            tip = HAND.tips((0.15, 0.10))[0] - [0.0, height]
            c, s = math.cos(angle), math.sin(angle)
            way = nearest_by_brute_force(corners, np.array([[c, s], [-s, c]]) @ tip)
            way = np.array([[c, -s], [s, c]]) @ way
            assert hand.d[0] == pytest.approx(RADIUS - np.hypot(*way), abs=1e-8)
            theta = math.remainder(math.atan2(way[1], way[0]) + 0.15 - hand.theta[0], math.tau)
            assert theta == pytest.approx(0, abs=1e-3)
            kinds.add(min(np.hypot(*(tip - way_)) for way_ in corners) < 0.02)
    assert kinds == {True, False}


def test_a_disc_is_touched_in_the_direction_of_its_centre():
    hand = make(object_shape="disc", object_radius=0.025)
    for height in np.linspace(0.06, 0.10, 9):
        place(hand, (0.1, 0.12), (0.002, height, 1.0))
        away = np.array([0.002, height]) - HAND.tips((0.1, 0.12))[0]
        assert hand.d[0] == pytest.approx(RADIUS + 0.025 - np.hypot(*away), abs=1e-15)
        assert hand.theta[0] == pytest.approx(math.atan2(away[1], away[0]) + 0.1, abs=1e-14)


def springs_on_a_cylinder(d, theta, curved):
    """Return the force and energy of springs under a cylinder, relative to those under a plane."""
    away = RADIUS - d + curved
    centre = away * np.array([math.sin(theta), math.cos(theta)])
    x = np.linspace(-RADIUS, min(RADIUS, centre[0] + curved), 50_001)
    face = centre[1] - np.sqrt(np.maximum(curved**2 - (x - centre[0]) ** 2, 0.0))
    inside = np.sqrt(np.maximum(RADIUS**2 - x * x, 0.0)) > face
    low, high = x[inside][[0, -1]]
    t, weight = np.polynomial.legendre.leggauss(120)
    t, weight = 0.5 * math.pi * t, 0.5 * math.pi * weight
    x = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(t)
    weight = weight * 0.5 * (high - low) * np.cos(t)
    q = centre[1] - np.sqrt(curved**2 - (x - centre[0]) ** 2)
    square = RADIUS**2 - x * x
    b = np.sqrt(np.maximum(square - q * q, 0.0))
    angle = np.arctan2(b, q)
    force = (2 * b - 2 * q * angle) @ weight
    energy = 0.5 * ((square + 2 * q * q) * angle - 3 * q * b) @ weight
    c = math.cos(theta)
    return force / (math.pi * d * d / c), energy / (math.pi * d**3 / (3 * c * c))


@pytest.mark.parametrize(
    ("curved", "upright", "tilted"), [(1.0, 1.5e-3, 1e-3), (0.04, 0.02, 0.023), (0.02, 0.01, 0.045)]
)
def test_curvature_softens_the_contact_like_the_springs(curved, upright, tilted):
    share = make(object_shape="disc", object_radius=curved).plant.parameters.factor
    for d in (0.001, 0.004, 0.008):
        assert springs_on_a_cylinder(d, 0.0, curved) == pytest.approx((share,) * 2, rel=upright)
        assert springs_on_a_cylinder(d, math.radians(30), curved) == pytest.approx(
            (share,) * 2, rel=tilted
        )
    # In the limit of small d, the share is exact.
    assert springs_on_a_cylinder(1e-4, 0.3, curved) == pytest.approx((share,) * 2, rel=1e-3)


@pytest.mark.parametrize("shape", ["disc", "none"])
def test_pressure_of_a_disc_or_another_tip_integrates_to_its_force(shape):
    settings = Settings.model_validate(
        {
            "simulation": {"object_shape": shape, "tactile_noise": 0.0},
            "material": {"law": "constant"},
        }
    )
    clock = VirtualClock()
    hand = SimulatedHand(settings, table=PAPER)
    sensors = [SimulatedTactile(settings, hand, clock, finger) for finger in range(2)]
    for sensor in sensors:
        sensor.open()
    for joint in range(2):
        hand.drive(joint, BOUNDED, True, 0.9, 0.3)
    clock.sleep_until(2.0)
    cell = settings.tactile.pitch**2 * settings.tactile.pascal_per_count
    for finger, sensor in enumerate(sensors):
        frame = sensor.latest()
        assert frame.data.sum() * cell == pytest.approx(hand.force[finger], rel=0.01)
        assert hand.force[finger] > 3


# Contact between tips.


def test_an_object_separates_the_tips_until_it_is_removed():
    hand = make()
    settled(hand, (0.9, 0.9), 0.4, 1.0)
    assert hand.on_other_tip.tolist() == [0.0, 0.0]
    held = hand.q.copy()
    place(hand, hand.q, (0.0, 0.4, 0.0))
    run(hand, 1.0)
    assert hand.on_other_tip.tolist() == [1.0, 1.0]
    assert (hand.q > held + 0.1).all()


# Palm.


@pytest.mark.parametrize("scene", ["rectangle", "disc"])
def test_an_object_slides_on_the_palm_with_coulomb_friction(scene):
    friction = 0.2
    hand = make(
        object_shape=scene,
        object_radius=0.03,
        palm=0.05,
        palm_friction=friction,
        gravity=(0.0, -GRAVITY),
    )
    sunk = 0.1 * GRAVITY / (1e5 if scene == "disc" else 2e5)
    place(hand, (-0.5, -0.5), (-0.02, 0.08 - sunk, 0.0), velocity=(0.3, 0.0, 0.0))
    run(hand, 0.03)
    spin = 0.0 if scene == "rectangle" else -friction * GRAVITY * 2 / 0.03 * 0.03
    assert hand.object_velocity[0] == pytest.approx(0.3 - friction * GRAVITY * 0.03, rel=0.02)
    assert hand.object_velocity[2] == pytest.approx(spin, rel=0.05, abs=0.3)
    run(hand, 0.17)
    # The rectangle slides for v²/(2μg) and stops. The disc finally rolls at two thirds of its
    # initial velocity.
    rolling = 0.0 if scene == "rectangle" else 0.3 * 2 / 3
    assert hand.object_velocity[0] == pytest.approx(rolling, abs=2e-3)
    assert hand.object_velocity[2] * 0.03 == pytest.approx(-rolling, abs=2e-3)
    if scene == "rectangle":
        way = 0.3**2 / (2 * friction * GRAVITY)
        # The object rocks slightly.
        assert hand.object_pose[0] + 0.02 == pytest.approx(way, rel=0.06)


def test_an_object_sticks_to_the_palm_below_friction_and_slides_above():
    for push, slides in ((0.9, False), (1.1, True)):
        hand = make(palm=0.05, palm_friction=0.5, gravity=(0.0, -GRAVITY), object_height=0.02)
        place(hand, (-0.5, -0.5), (0.0, 0.06, 0.0))
        run(hand, 0.3)
        hand.apply_load(push * 0.5 * 0.1 * GRAVITY, 0.0)
        run(hand, 0.1)
        at = hand.object_pose[0]
        run(hand, 0.15)
        assert (hand.object_pose[0] - at > 1e-3) == slides
        if not slides:
            assert hand.object_pose[0] == pytest.approx(at, abs=1e-9)


# Errors.


def test_a_long_wedge_whose_faces_meet_is_refused():
    from softfinger.daemon.profile.validation import problems

    def found(**simulation):
        settings = Settings.model_validate({"simulation": {"object_shape": "wedge", **simulation}})
        return problems(settings)

    assert found(object_taper=1.1) == []
    assert "object_taper" in found(object_taper=1.2)[0]
    assert "object_taper" in found(object_taper=0.5, object_height=0.3)[0]
    with pytest.raises(
        ValueError, match=r"simulation\.object_width: found 0\.002 m, expected more than"
    ):
        shape(object_shape="wedge", object_width=0.002)
