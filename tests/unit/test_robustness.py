"""Test hands that differ from their settings; the plant's true values are the reference."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from softfinger.daemon.perception.finger_model import make_models
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.perception.unloaded_cells import UnloadedCells
from softfinger.daemon.profile.factory import make_grid, make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.rigs import GripCase, VirtualGrip, merged
from softfinger.tools.benchmarks.robustness import ROWS, drawn, drawn_in_mujoco, grip

ROW = {case.name: case for case in ROWS}
LONG = pytest.mark.extended


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("as set", 1),
        ("joint friction 0.12 N·m", 1),
        ("joint friction 0.20 N·m", 1),
        pytest.param("stiction 0.15 N·m", 1, marks=LONG),
        pytest.param("zero +5% in 20 s, 8 bits", 1, marks=LONG),
        ("frames 15 ms older", 1),
        ("frames 10 ms older", 1),
        *(pytest.param(name, 1, marks=LONG) for name in ("frames 30 ms older", "cells of 80 ms")),
        ("both gains and currents halve in 5 s", 1),
    ],
)
def test_unknown_hand_parameters_do_not_change_the_force(name, seed):
    found = grip(ROW[name], seed)
    assert found.held
    assert found.settled == pytest.approx(1.0, abs=0.2)
    assert found.peak < 1.3
    assert not found.raised
    assert found.accused == ()


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("zero -5% in 20 s", 1),
        pytest.param("zero -2% in 20 s", 2, marks=LONG),
        pytest.param("zero -5% in 20 s, 8 bits", 2, marks=LONG),
    ],
)
def test_a_falling_zero_offset_is_named_and_the_grip_continues(name, seed):
    """Readings are clipped at 0, so only the joints' motion shows how far the offset has fallen."""
    found = grip(ROW[name], seed)
    assert found.end == "holding"
    assert found.settled == pytest.approx(1.0, abs=0.2)
    assert found.peak < 1.3
    assert found.named < math.inf or found.peak < 1.2
    assert not found.raised


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("force", [6.0, pytest.param(20.0, marks=LONG)])
def test_frames_up_to_the_default_latency_do_not_change_the_force(delay, force):
    late = GripCase("late", force, {"simulation": {"tactile_delay": delay}})
    found = grip(late)
    assert found.settled == pytest.approx(1.0, abs=0.1)
    assert found.accused == ()


@pytest.mark.parametrize(("friction", "stiction"), [(0.05, 0.0), (0.12, 0.0), (0.05, 0.1)])
def test_joint_friction_is_estimated_during_the_approach(friction, stiction):
    hand = {"simulation": {"joint_friction": friction, "joint_stribeck": stiction}}
    with VirtualGrip({}, hand) as grip:
        grip.command("arm")
        grip.loop.advance(0.1)
        grip.command("grasp", force=6.0)
        assert grip.until("holding", 4.0)
        # The estimate includes the joint damping. The estimate also includes the static friction
        # that remains when a joint starts to move.
        shown = grip.estimator.grasp.free_torque
        assert (shown > friction + 0.5 * stiction).all()
        assert (shown < friction + stiction + 0.025).all()


@pytest.mark.parametrize(
    ("friction", "torque", "force"), [(0.13, 0.87, 4.4), (0.12, 0.9, 6.0), (0.15, 0.9, 6.0)]
)
def test_friction_and_a_weak_motor_do_not_leave_a_force_error(friction, torque, force):
    hand = {"simulation": {"joint_friction": friction, "joint_stribeck": 0.05}}
    with VirtualGrip({}, hand, torque) as grip:
        grip.command("arm")
        grip.loop.advance(0.1)
        grip.command("grasp", force=force)
        assert grip.until("holding", 4.0)
        assert grip.plant.force.min() > 0.82 * force


@pytest.mark.extended
def test_old_frames_and_slow_cells_do_not_change_the_force():
    """In this hand, frames are 37 ms older, and the cells respond within 73 ms."""
    found = grip(drawn(275))
    assert found.settled == pytest.approx(1.0, abs=0.12)
    assert not found.raised
    assert found.accused == ()


@pytest.mark.extended
def test_hands_of_the_ensemble_grip_in_mujoco():
    pytest.importorskip("mujoco")
    case = drawn_in_mujoco(3)
    with VirtualGrip(case.daemon, merged(case.hand, case.daemon)) as hand:
        hand.command("arm")
        hand.loop.advance(0.1)
        hand.command("grasp", force=case.force)
        assert hand.until("holding", 4.0)
        assert hand.plant.force.mean() == pytest.approx(case.force, rel=0.2)


def test_equal_seeds_give_equal_hands():
    assert drawn(7) == drawn(7)
    hands = [drawn(seed) for seed in range(1, 201)]
    delays = [hand.hand["simulation"]["tactile_delay"] for hand in hands]
    assert min(delays) < 0.025 < 0.055 < max(delays) <= 0.06
    assert 0.4 < np.mean([hand.load != 0.0 for hand in hands]) < 0.6


def frames(zero: float, cells: int = 32, pressed: int = 200) -> np.ndarray:
    """Return the counts for a 20 mm tip with an indentation of 3 mm, plus a zero offset."""
    at = (np.arange(cells) - 0.5 * (cells - 1)) * 0.058 / cells
    inside = np.hypot(*np.meshgrid(at, at)) < 10.5e-3
    return np.where(inside, pressed + zero, zero).astype(np.uint16)


def unpressed(side: float = 0.058) -> UnloadedCells:
    grid = SensorGrid(32, 32, side / 32)
    return UnloadedCells(grid, 0.02, np.ones(grid.shape, np.bool_))


def test_a_rising_zero_offset_is_subtracted_and_saturated_cells_stay_saturated():
    cells = unpressed()
    for zero in (3, 4, 9):
        cells.update(frames(zero))
    assert cells.zero_shift == 6
    counts = frames(9)
    counts[16, 16] = 255
    corrected = cells.corrected(counts, 255)
    assert corrected[16, 16] == 255
    assert corrected[0, 0] == 3
    assert corrected[16, 14] == 203
    cells.reset_zero()
    assert cells.corrected(counts, 255) is counts


@pytest.mark.parametrize(
    ("spread", "dead"),
    [(1500.0, {}), (0.0, {(0, c): 60_000 for c in range(44)}), (0.0, {(20, 20): 50_000})],
    ids=["offsets that differ", "a dead row", "a dead cell under the tip"],
)
def test_tared_offsets_and_listed_dead_cells_do_not_count_as_noise(spread, dead):
    tactile = {"full_count": 65_535, "dead": (tuple(dead), ())}
    settings = Settings.model_validate({"loop": {"clock": "virtual"}, "tactile": tactile})
    sensor = SimpleNamespace(latest=lambda: None)
    finger = FingerPerception(sensor, make_models(settings)[0], settings, [])
    rng, grid = np.random.default_rng(1), make_grid(settings, 0)
    rest = 9000.0 + rng.normal(0.0, spread, grid.shape)
    scale, noise = settings.tactile.pascal_per_count, settings.tactile.noise
    pressed = grid.pressure(make_tip(settings), make_material(settings.material), 2e-3) / scale
    for k in range(120):
        counts = rest + rng.normal(0.0, noise / scale, grid.shape) + pressed * (k >= 100)
        for cell, value in dead.items():
            counts[cell] = value
        frame = Frame(k, 0.01 * k, 0.01 * k, True, np.rint(counts).astype(np.uint16))
        sensor.latest = lambda frame=frame: frame
        if k == 5:
            finger.tare()
        finger.update()
    assert finger.noise == pytest.approx(noise, rel=0.2)
    assert finger._estimator.saturation > 50_000
    assert finger.estimate.d == pytest.approx(2e-3, rel=0.05)


def test_a_second_contact_near_the_tip_is_not_a_zero_offset():
    cells = unpressed()
    cells.update(frames(3))
    touched = frames(3)
    touched[:, :6] = 100
    cells.update(touched)
    assert cells.zero_shift == 0


def test_a_sensor_covered_by_the_tip_gives_no_offset_and_no_noise():
    cells = unpressed(side=0.018)
    for zero in (3, 9):
        cells.update(frames(zero))
    assert cells.zero_shift == 0
    assert cells.noise == 0.0


@pytest.mark.parametrize("zero", [0, 40])
@pytest.mark.parametrize("sigma", [1.0, 3.0, 12.0])
def test_noise_is_measured_on_cells_without_contact(zero, sigma):
    cells, rng = unpressed(), np.random.default_rng(1)
    for _ in range(40):
        noisy = frames(zero) + rng.normal(0.0, sigma, (32, 32))
        cells.update(np.clip(np.rint(noisy), 0, 255).astype(np.uint16))
    assert cells.noise == pytest.approx(sigma, rel=0.25)
