"""Test the prediction of servo temperatures with unknown constants, and the daemon's reactions."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.heat import set_law
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.servo_fit import fit_heat
from softfinger.kinematics.hand.servo_heat import (
    TIME_MAX,
    HeatState,
    follow,
    sustained_square,
    time_to_limit,
)
from softfinger.tools.calibration import joints as calibrating
from softfinger.tools.cli import main
from softfinger.tools.simulated_daemon import SimulatedDaemon
from tests.harness.golden_recording import RECORDING
from tests.soak.heat import Bench, foreseen, least_at_half_load

LIMIT = 70.0
# Heating, cooling and heat capacity of the plant's servos, as factors of the model's values.
FAST = (1.2, 0.8, 0.3)


def law(state: HeatState) -> HeatState:
    set_law(state.law, Settings())
    return state


def derivative(state: HeatState, x: Any, square: float) -> Any:
    """Return the derivatives of W, C, A and k (equations in the docstring of `hand.servo_heat`)."""
    c = state.law
    winding, case, ambient, heating = x
    copper = 1.0 + 0.0039 * (winding - 25.0)
    flow = (winding - case) / c.winding_time
    draught = (max(case - ambient, 1.0) / 30.0) ** 0.25
    return np.array(
        [
            heating * c.heating * square * copper - flow,
            c.share * flow - draught * (case - ambient) / c.case_time,
            0.0,
            0.0,
        ]
    )


@pytest.mark.parametrize("square", [0.4, 1.0, 2.5])
def test_the_time_to_the_limit_matches_the_equations(square):
    state = law(HeatState())
    follow(state.array, 0.0, 0.5, 30.0)
    state.x[:] = 45.0, 38.0, 28.0, 1.1

    def reached(_: float, x: Any) -> float:
        return float(x[1]) - LIMIT

    reached.terminal = True
    solved = solve_ivp(
        lambda _, x: derivative(state, x, square),
        (0.0, TIME_MAX),
        state.x,
        events=reached,
        rtol=1e-8,
    )
    assert time_to_limit(state.array, square, LIMIT) == pytest.approx(solved.t[-1], rel=0.02)


def test_the_lasting_current_settles_at_the_limit():
    state = law(HeatState())
    follow(state.array, 0.0, 0.5, 30.0)
    square = sustained_square(state, LIMIT)
    solved = solve_ivp(
        lambda _, x: derivative(state, x, square), (0.0, 4e4), state.x, method="LSODA"
    )
    assert solved.y[1, -1] == pytest.approx(LIMIT, abs=0.1)
    assert time_to_limit(state.array, square, LIMIT + 1.0) == TIME_MAX
    state.x[2] = LIMIT + 5.0
    assert sustained_square(state, LIMIT) == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_the_limit_is_predicted_with_unknown_constants(seed):
    run = foreseen(seed)
    assert run.warned >= 30.0
    assert run.told == pytest.approx(60.0, rel=0.15)


def test_the_winding_error_matches_its_standard_deviation():
    ratios = []
    for seed in range(8):
        bench = Bench(seed)
        current, told = 1.3 * bench.lasting_current(), bench.state.heat[0]
        for _ in range(3):
            for _ in range(100):
                bench.step(current)
            ratios.append((told.winding - bench.plant.winding) / told.winding_std)
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.5
    assert np.abs(ratios).max() < 3.0


def test_a_failed_first_reading_does_not_change_the_prediction():
    plain, late = Bench(0), Bench(0)
    late.state.reading.t = -math.inf
    late._watch.update()
    for _ in range(20):
        told = plain.step(2.0)
        assert late.step(2.0) == told
    assert told < TIME_MAX


def test_a_gap_of_weeks_between_readings_does_not_occupy_a_tick(monkeypatch):
    steps: list[float] = []

    def counted(array: Any, square: float, dt: float, sensed: float) -> None:
        steps.append(dt)
        follow(array, square, dt, sensed)

    monkeypatch.setattr("softfinger.daemon.safety.heat.follow", counted)
    bench = Bench(0)
    bench.step(0.0)
    bench.t += 14.0 * 86_400.0  # The servos had no supply.
    bench.plant.warm(20.0)
    bench.step(0.0)
    assert len(steps) < 20_000
    assert bench.state.heat[0].case == pytest.approx(20.0, abs=1.0)


def test_half_of_the_lasting_current_causes_no_warning():
    assert least_at_half_load(1, 1800.0) > 600.0


HOLD = 600.0  # s


def recorded(plant: ServoHeat) -> dict[str, Any]:
    """Record a hold at 1 A and return its values."""
    t, shown = np.arange(0.0, HOLD, 0.5), []
    for _ in t:
        plant.step(1.0, 0.5)
        shown.append(float(round(plant.sensed)))
    return {"t": t, "left.current": np.ones_like(t), "left.temperature": np.array(shown)}


def test_servo_constants_are_identified_from_a_hold(tmp_path, monkeypatch, capsys):
    plant = ServoHeat(by_name("XM430-W350"), 1.25, 0.8, 0.8)
    monkeypatch.setattr(calibrating, "read_recording", lambda _: recorded(plant))
    profile = tmp_path / "my.toml"
    profile.write_text("[servos]\nheat_time = 1.0\n")
    assert main(["calibrate", "heat", str(profile), "--recording", "hold.mcap"]) == 0
    assert "K/A² in" in capsys.readouterr().out
    state, own = HeatState(), load(profile)
    set_law(state.law, own)
    follow(state.array, 1.0, 0.5, 25.0)
    plant.warm(25.0)
    state.x[:3] = 25.0
    told = time_to_limit(state.array, 1.0, 60.0)
    t = 0.0
    while plant.case < 60.0:
        plant.step(1.0, 1.0)
        t += 1.0
    assert told == pytest.approx(t, rel=0.05)
    follow(law(state).array, 1.0, 0.5, 25.0)
    state.x[:3] = 25.0
    # The model's own constants give a wrong prediction.
    assert abs(time_to_limit(state.array, 1.0, 60.0) / t - 1.0) > 0.2


def test_a_hold_with_little_heating_is_refused(tmp_path, capsys):
    profile = tmp_path / "my.toml"
    profile.write_text("")
    assert main(["calibrate", "heat", str(profile), "--recording", str(RECORDING)]) == 1
    assert "found a temperature rise of 0 °C, expected at least 8 °C" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("current", "rise", "told"),
    [
        (0.0, lambda t: 12.0 * (t > 300.0), "found no current"),
        (1.0, lambda t: 12.0 * (t > 300.0), "found a residual of 3 °C, expected less than 2 °C"),
        (1.0, lambda t: 40.0 * (1.0 - np.exp(-t / 20.0)), "found a residual of"),
        (5.0, lambda t: 10.0 * (1.0 - np.exp(-t / 200.0)), "found a residual of"),
    ],
)
def test_readings_that_the_heat_model_does_not_fit_are_refused(current, rise, told):
    t = np.arange(0.0, HOLD, 0.5)
    with pytest.raises(CalibrationError, match=told):
        fit_heat(law(HeatState()).law, t, np.full_like(t, current), 25.0 + np.round(rise(t)))


def test_heat_data_with_a_jump_in_time_are_refused():
    t = np.append(np.arange(600.0), 1e9)
    reading = 25.0 + np.linspace(0.0, 20.0, t.size)
    with pytest.raises(CalibrationError, match="expected at most 3600 s"):
        fit_heat(law(HeatState()).law, t, np.full_like(t, 0.8), reading)


def test_readings_that_the_heat_model_fits_roughly_are_accepted():
    run = recorded(ServoHeat(by_name("XM430-W350"), 1.25, 0.8, 0.8))
    t, current, reading = run.values()
    assert fit_heat(law(HeatState()).law, t, current, reading + 6.0 * (t > 300.0)).residual > 1.2


def hot(force: float, seconds: float, **sections: dict[str, Any]) -> SimulatedDaemon:
    """Grip with servos that overheat quickly, at half the usual frame rate."""
    sections |= {"simulation": {"servo_heat": FAST, "ambient": 35.0}, "tactile": {"rate": 50.0}}
    hand = SimulatedDaemon(sections)
    hand.grasp(force)
    hand.run(2.0)
    assert hand.mode == Mode.HOLDING
    for heat in hand.plant.servo_heat:
        heat.warm(60.0)
    hand.run(seconds)
    return hand


def heat_events(hand: SimulatedDaemon) -> list[tuple[str, str]]:
    return [(level, text) for level, kind, text in hand.events if kind == "servos.heat"]


def test_an_overheating_grip_is_eased_and_keeps_holding():
    with hot(24.0, 45.0) as hand:
        assert hand.mode == Mode.HOLDING
        assert max(heat.sensed for heat in hand.plant.servo_heat) < LIMIT
        told = heat_events(hand)
        assert any("the grip force was reduced from 24.0 to" in text for _, text in told)
        assert {level for level, _ in told} == {"warning"}
        eased = hand.state.goal.force
        assert 4.5 < eased < 22.0
        assert hand.plant.force.mean() == pytest.approx(eased, rel=0.05)
        hand.command("grasp", force=24.0)  # Request 24 N again with hot servos.
        hand.run(1.0)
        assert hand.state.goal.force == pytest.approx(eased)


@pytest.mark.parametrize(("seconds", "told"), [(0.1, False), (2.0, True)])
def test_the_force_is_reduced_only_after_both_tips_have_touched_the_object(seconds, told):
    with SimulatedDaemon({}) as hand:
        hand.grasp(8.0)
        hand.run(seconds)
        watch = hand.loop._heat
        for finger, heat in enumerate(hand.state.heat):
            watch._square[finger], heat.time_to_limit = 4.0, 20.0
        assert watch.act(hand.control) == ""
        hand.run(2.0)
        assert any("was reduced" in text for _, text in heat_events(hand)) == told
        assert (hand.control.grip.commanded < 8.0) == told


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        ("release", Mode.ARMED),
        pytest.param("hold", Mode.FAULT, marks=pytest.mark.extended),
        pytest.param("stop", Mode.DISARMED, marks=pytest.mark.extended),
    ],
)
def test_if_the_load_needs_the_force_the_configured_action_is_reported_and_taken(action, mode):
    # At 24 N, the friction just carries the load, so the hand would drop the object at a lower
    # force.
    control = {"object_load": 23.5}
    with hot(24.0, 0.0, control=control, safety={"heat_action": action}) as hand:
        for _ in range(90):
            hand.run(1.0)
            if hand.mode != Mode.HOLDING:
                break
        hand.run(2.0)
        assert hand.mode == mode
        (text,) = [text for level, text in heat_events(hand) if level == "error"]
        assert text.endswith(
            f"and the load does not allow a lower grip force; safety.heat_action = {action}"
        )
        if action == "hold":
            assert hand.state.fault_name == "servos.temperature"
