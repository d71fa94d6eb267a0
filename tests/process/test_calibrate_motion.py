"""Test that `calibrate friction` and `calibrate latency` move a hand through its daemon."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from softfinger import Hand
from softfinger.daemon.profile.load import load
from softfinger.tools.cli import main
from tests.conftest import own_addresses
from tests.harness.daemon_process import Running
from tests.harness.emulated import HIL, EmulatorProcess

# True friction [N·m], static friction [N·m] and latency [s] of the hand. The profile has a friction
# of 0.05 N·m and a latency of 0.015 s.
FRICTION, AT_REST, LATENCY = 0.09, 0.13, 0.035
BYTES = 5.13e-3  # transmission time of a frame [s]
COUNT = 1.78 * 2.69e-3  # torque per current count [N·m]
PLANT = {
    "simulation.joint_friction": FRICTION,
    "simulation.joint_stribeck": AT_REST - FRICTION,
    "simulation.tactile_delay": LATENCY + BYTES,
}
WAITING = ["--set", "servos.fault_after=1.0", "--set", "safety.frame_age_fault=100"]

Calibrate = Callable[..., int]


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Hand]]:
    """Yield the hand's profile and a client connected to its daemon."""
    folder = tmp_path_factory.mktemp("hand")
    addresses = own_addresses()
    profile = folder / "my.toml"
    head = f'stream.address = "{addresses[0]}"\ncommands.address = "{addresses[1]}"\n'
    profile.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
    words = [word for key, value in PLANT.items() for word in ("--set", f"{key}={value}")]
    with EmulatorProcess("--dir", folder, "--config", HIL, *words) as emulator:
        emulator.ready()
        daemon = Running("--config", str(profile), "--dir", str(folder), *WAITING)
        try:
            with Hand(*addresses, timeout=120.0) as client:
                yield profile, client
        finally:
            daemon.kill()


@pytest.fixture
def calibrate(hand: tuple[Path, Hand]) -> Calibrate:
    """Return a function that runs a calibration step on the module's hand and then disarms it."""
    profile, client = hand
    address = f"{client.stream_address},{client.command_address}"
    where = ["--dir", str(profile.parent), "--address", address, "--move", "true"]

    def run(step: str, *words: str) -> int:
        return main(["calibrate", step, str(profile), *where, *words])

    return run


@pytest.mark.extended
def test_friction_is_calibrated_by_sweeping_a_joint(hand, calibrate, capsys):
    profile, client = hand
    assert calibrate("friction", "--set", 'scene.fingers=["left"]') == 0
    told = capsys.readouterr()
    assert (
        "keep the space around the fingers free; the joints will sweep left 0° to -23°" in told.err
    )
    # At the velocities of the sweeps, a tenth of the additional static friction remains.
    found = load(profile, profile.parent)
    assert found.control.joint_friction == pytest.approx(FRICTION, abs=2 * COUNT)
    shown = float(told.out.split("at break-away ")[1].split(" ")[0])
    assert shown == pytest.approx(AT_REST, abs=3 * COUNT)
    assert client.state().mode == "disarmed"


def test_latency_is_calibrated_by_grasps_at_several_forces(hand, calibrate, capsys):
    profile, client = hand
    assert calibrate("latency", "--force", "8") == 0
    told = capsys.readouterr()
    assert "put an object between the fingers; the hand will grasp it with 8 N" in told.err
    assert "(the daemon used 15 ms) from " in told.out
    assert load(profile, profile.parent).tactile.latency == pytest.approx(LATENCY, abs=4e-3)
    assert client.state().mode == "disarmed"


def test_a_contact_during_the_sweep_turns_torque_off(hand, calibrate, capsys):
    profile, client = hand
    before = profile.read_text(encoding="utf-8")
    assert calibrate("friction", "--set", "hand.q_min=[-0.1,-0.1]") == 1
    assert "friction: left: a tip is in contact" in capsys.readouterr().err
    assert client.wait_for(lambda state: not state.torque, 60.0).mode == "disarmed"
    assert profile.read_text(encoding="utf-8") == before


def test_a_hand_in_use_is_not_moved(hand, calibrate, capsys):
    _, client = hand
    client.arm()
    client.grasp(force=5.0)
    client.wait_for(lambda state: state.mode == "holding", 120.0)
    try:
        assert calibrate("friction") == 1
        assert "found mode holding, expected disarmed or armed" in capsys.readouterr().err
        assert client.state().mode == "holding"
    finally:
        client.stop()
