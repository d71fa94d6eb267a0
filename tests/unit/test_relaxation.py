"""Test the plant's tip relaxation and energy decay against integrals of the Prony terms."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from softfinger.daemon.profile.factory import make_material, make_tip
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.simulated_tactile import make_sensor_model
from softfinger.kinematics.calibration.calibration import CalibrationError, fit_relaxation, follow
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks.rigs import SOLID
from softfinger.tools.cli import main
from softfinger.tools.simulated_daemon import SimulatedDaemon

STRENGTHS, TIMES = (0.2, 0.15, 0.25), (0.004, 0.07, 1.4)
SPEED = 0.02  # m/s


def pressed(**more: Any) -> SimulatedHand:
    """Return a hand with one finger, against which the object moves back and forth."""
    simulation = {
        "tip_relaxation": STRENGTHS,
        "tip_relaxation_times": TIMES,
        "compression_speed": SPEED,
        "tip_friction": 0.0,
        "tip_loss": 0.0,
    }
    return SimulatedHand(
        Settings.model_validate(
            {
                "scene": {"fingers": ("left",)},
                "servos": {"backend": "none"},
                "material": {"law": "constant"},
                "simulation": simulation | more,
            }
        )
    )


def test_pressing_and_releasing_follow_the_prony_terms():
    hand = pressed()
    rows = []
    for k in range(1, 4000):
        hand.advance(1e-3 * k)
        d = float(hand.d[0])
        lasting = float(hand.table(max(d, 0.0), float(hand.theta[0])).force) if d > 0.0 else 0.0
        rows.append((hand.t, lasting, float(hand.force[0])))
    t, lasting, force = np.array(rows).T
    # The tip is pressed and released.
    assert np.count_nonzero(np.diff((lasting > 0.0).astype(int))) >= 3

    def followed(now: float, h: np.ndarray) -> np.ndarray:
        return (np.interp(now, t, lasting) - h) / np.array(TIMES)

    found = solve_ivp(
        followed, (t[0], t[-1]), np.zeros(3), "LSODA", t, rtol=1e-8, atol=1e-8, max_step=2e-3
    )
    expected = lasting + np.array(STRENGTHS) @ (lasting - found.y)
    expected = np.where(lasting > 0.0, np.maximum(expected, 0.02 * lasting), 0.0)
    deep = lasting > 1.0
    np.testing.assert_allclose(force[deep], expected[deep], rtol=0.02, atol=0.05)
    rising = deep & (np.gradient(lasting) > 0.0)
    assert (force[rising] > 1.1 * lasting[rising]).mean() > 0.9
    falling = deep & (np.gradient(lasting) < 0.0)
    assert (force[falling] < lasting[falling]).any()


def test_relaxing_tips_do_not_generate_energy():
    """Let a free object bounce between relaxing tips, without other damping, until it stops."""
    settings = Settings.model_validate(
        {
            "material": {"law": "constant"},
            "hand": {"open_angle": (0.18, 0.18)},
            "servos": {"backend": "none"},
            "simulation": {
                "tip_relaxation": STRENGTHS,
                "tip_loss": 0.0,
                "tip_friction": 0.0,
                "table_friction": 0.0,
                "compression_speed": 0.0,
                "object_position": (0.0008, 0.080),
            },
        }
    )
    hand = SimulatedHand(settings)
    speeds = []
    for k in range(1, 1000):
        hand.advance(2e-3 * k)
        speeds.append(float(np.hypot(*hand.object_velocity[:2])))
    assert max(speeds[:50]) > 0.02
    assert max(speeds[-100:]) < 0.05 * max(speeds[:50])


@pytest.mark.parametrize("strengths", [(0.0, 0.15, 0.25), (0.0, 0.3, 0.0), (0.0, 0.0, 0.0)])
def test_press_and_hold_gives_the_strengths(strengths):
    """Fit a noisy force, sampled too slowly (100 Hz) to resolve the shortest time constant."""
    t = np.arange(-1.0, 6.0, 0.01)
    lasting = 12.0 * np.clip(t / 0.1, 0.0, 1.0) ** 1.6

    def rate(now: float, h: np.ndarray) -> np.ndarray:
        return (12.0 * min(max(now, 0.0) / 0.1, 1.0) ** 1.6 - h) / np.array(TIMES)

    h = solve_ivp(rate, (t[0], t[-1]), np.zeros(3), "LSODA", t, rtol=1e-9, max_step=0.01).y
    force = 0.8 * (lasting + np.array(strengths) @ (lasting - h))
    force += np.random.default_rng(3).normal(0.0, 0.02, t.size)
    found = fit_relaxation(t, force, TIMES)
    assert found.strengths == pytest.approx(strengths, abs=0.015)
    assert found.strengths[0] == 0.0
    assert found.residual < 0.02
    if any(strengths):
        assert found.elastic > 2.0 * found.residual


def test_too_short_a_hold_is_refused():
    t = np.arange(0.0, 1.0, 0.01)
    with pytest.raises(
        CalibrationError, match=r"held for 1\.0 s, expected at least 2\.8 s \(2 times"
    ):
        fit_relaxation(t, np.ones_like(t), TIMES)


@pytest.mark.parametrize("strength", [0.3, 2.0])
def test_a_release_is_refused_but_not_a_strong_relaxation(strength):
    t = np.arange(0.0, 8.0, 0.01)
    force = np.clip(t / 0.1, 0.0, 1.0) * (1.0 + strength * np.exp(-t / TIMES[2]))
    assert fit_relaxation(t, force, TIMES).strengths[2] == pytest.approx(strength, rel=0.1)
    with pytest.raises(CalibrationError, match="the force fell to 0% of its maximum"):
        fit_relaxation(t, np.where(t > 7.5, 0.0, force), TIMES)


def grip(aware: bool, tip: dict[str, Any]) -> tuple[float, float, list[str]]:
    """Hold with 8 N; return the relative true forces after 1 s and at the end, and all warnings."""
    sections: dict[str, dict[str, Any]] = {name: dict(values) for name, values in tip.items()}
    sections.setdefault("simulation", {})["tip_relaxation"] = STRENGTHS
    if aware:
        sections.setdefault("tip", {})["relaxation"] = STRENGTHS
    with SimulatedDaemon(sections) as hand:
        hand.grasp(8.0)
        hand.run(3.0)
        first = float(np.mean(hand.plant.force)) / 8.0
        hand.run(8.0)
        warned = [kind for level, kind, _ in hand.events if level != "info"]
        return first, float(np.mean(hand.plant.force)) / 8.0, warned


@pytest.mark.parametrize("tip", [{}, pytest.param(SOLID, marks=pytest.mark.extended)])
def test_a_hold_keeps_its_force_with_known_relaxation(tip):
    first, last, warned = grip(True, tip)
    assert last == pytest.approx(first, abs=0.025)
    assert last == pytest.approx(1.0, abs=0.05)
    assert warned == []


def test_undeclared_relaxation_does_not_raise_the_grip():
    _, last, warned = grip(False, {})
    assert 0.7 < last < 1.2
    assert "slip" not in warned


def test_calibrate_finds_relaxation_in_a_frame_recording(tmp_path, capsys):
    profile = load(Path("sim"))
    grid = make_sensor_model(profile, 0).grid
    t = np.arange(0.0, 5.0, 0.02)  # half of tactile.rate
    d = 0.004 * np.minimum(t / 0.2, 1.0)
    tip, material = make_tip(profile), make_material(profile.material)
    lasting = ContactTable.build(tip, material)(d, 0.0 * d).force
    h = np.array([follow(t, lasting, time) for time in TIMES])
    relaxation_factor = 1.0 + np.array([0.0, 0.2, 0.3]) @ (1.0 - h / np.maximum(lasting, 1e-12))
    pressures = [grid.pressure(tip, material, each, 0.0) for each in d]
    counts = [rho * p / profile.tactile.pascal_per_count
              for rho, p in zip(relaxation_factor, pressures, strict=True)]  # fmt: skip
    run, file = tmp_path / "press.npz", tmp_path / "left.json"
    np.savez(run, frames=np.rint(counts).astype(np.uint16), d=d, t=t)
    assert main(["calibrate", "relaxation", str(file), "--recording", str(run)]) == 0
    said = capsys.readouterr().out
    found = [float(each) for each in re.findall(r"\d\.\d{3}", said.partition("[")[2])]
    assert found == pytest.approx([0.0, 0.2, 0.3], abs=0.02)
    assert (tmp_path / "left.relaxation.png").stat().st_size > 1000
