"""Test that a daemon finds, checks and uses the backends of an installed package."""

import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from softfinger.daemon.backends import backend
from softfinger.daemon.client.hand import Hand
from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import PluginError, SettingsError
from softfinger.daemon.profile.load import load
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.emulator.pty_bus import PtyPort
from softfinger.daemon.simulation.simulated_tactile import SimulatedTactile
from softfinger.daemon.types import Frame, Reading
from softfinger.testing import check_servos, check_shape, check_tactile
from softfinger.tools.setup import doctor
from tests.conftest import until
from tests.harness.daemon_process import PATIENT, pip_installed

EXAMPLE = Path(__file__).parents[1] / "example_plugin"
EXTENDED = pytest.mark.extended
METAL = ("tactile.backend=pulsing", "servos.backend=following")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the example with pip into its own folder."""
    return pip_installed(EXAMPLE, tmp_path_factory.mktemp("plugin"))


@pytest.fixture
def here(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the example to the import path of the test process."""
    monkeypatch.syspath_prepend(installed)


@pytest.mark.usefixtures("here")
def test_the_example_meets_the_backend_interface(caplog):
    settings = load(changes=METAL)
    check_tactile(settings)
    assert not caplog.records  # Closing a board before its first frame is not an error.
    check_servos(settings, torque=True)
    check_shape(load(changes=["simulation.object_shape=hexagon"]))
    found = {each.subject: each for each in doctor.results(settings, False)}
    assert found["servos"].text.startswith("following: the servos use a plugin")
    assert "44 × 44 cells" in found["tactile left"].text
    assert "/dev/ttyUSB0" not in found  # Ports of plugin backends are not checked.


@pytest.mark.parametrize("servos", ["simulated", pytest.param("mujoco", marks=EXTENDED)])
@pytest.mark.parametrize("clock", ["virtual", pytest.param("auto", marks=EXTENDED)])
def test_the_checks_support_backends_that_use_the_simulated_hand(servos, clock):
    if servos == "mujoco":
        pytest.importorskip("mujoco")
    settings = load(changes=[f"servos.backend={servos}", f"loop.clock={clock}"])
    check_tactile(settings)
    check_servos(settings, torque=True)


def test_times_in_the_future_are_found_in_virtual_time(monkeypatch):
    settings = load(changes=["loop.clock=virtual"])
    latest, read = SimulatedTactile.latest, SimulatedServos.read

    def early_frame(sensor: SimulatedTactile) -> Frame | None:
        frame = latest(sensor)
        return frame and replace(frame, t_arrival=frame.t_arrival + 0.1)

    def early_reading(servos: SimulatedServos, reading: Reading) -> None:
        read(servos, reading)
        reading.t += 0.1

    monkeypatch.setattr(SimulatedTactile, "latest", early_frame)
    monkeypatch.setattr(SimulatedServos, "read", early_reading)
    with pytest.raises(AssertionError, match="arrival time in the future"):
        check_tactile(settings)
    with pytest.raises(AssertionError, match="a reading with a time in the future"):
        check_servos(settings)


@pytest.mark.usefixtures("here")
def test_plugin_errors_are_part_of_the_report():
    wrong = (
        *METAL,
        "plugins.pulsing.height=-1",
        "plugins.pulsing.hight=1",
        "plugins.following.speed=1",
        "plugins.nobody.key=1",
    )
    with pytest.raises(SettingsError) as caught:
        load(changes=wrong)
    report = str(caught.value)
    with pytest.raises(SettingsError, match=r"broken from softfinger-example 1\.0 can't be loaded"):
        load(changes=["tactile.backend=broken"])
    with pytest.raises(PluginError):
        backend("tactile", "broken")
    for part in (
        "plugins.pulsing.height: found -1",
        "plugins.pulsing.hight: unknown key; nearest: height",
        "plugins.following: found settings, but plugin following from softfinger-example 1.0 does",
        "plugins.nobody: found settings, but no plugin of this name is installed",
    ):
        assert part in report
    with pytest.raises(SettingsError, match="'disc', 'wedge', 'none' or 'hexagon'"):
        load(changes=["simulation.object_shape=hexagonal"])


@pytest.mark.extended
def test_a_daemon_runs_with_plugin_backends(installed, start, profile, addresses, monkeypatch):
    path = os.pathsep.join((str(installed), os.environ.get("PYTHONPATH", "")))
    monkeypatch.setenv("PYTHONPATH", path)
    changes = [word for each in METAL for word in ("--set", each)]
    file = str(profile("[plugins.pulsing]\nheight = 5\n"))
    running = start("--config", file, *changes, *PATIENT)
    with Hand(*addresses, timeout=60.0) as hand:
        hand.arm()
        hand.move(left=0.3, right=0.2)
        until(lambda: abs(hand.state().left.q - 0.3) < 1e-3)
        hand.disarm()
    assert running.end() == 0


def test_the_ascii_board_of_the_documentation_reads_a_port():
    page = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    exec(page.split("```python\n")[-1].split("```")[0], names)
    port = PtyPort()
    path, master = port.path, port.fileno()
    settings = load(changes=["tactile.rows=4", "tactile.cols=5", f'tactile.port=["{path}", ""]'])
    sensor = names["AsciiBoard"](settings.tactile, RealClock(), 0)
    ended = threading.Event()

    def send() -> None:
        while not ended.wait(0.01):
            os.write(master, b",".join(b"%d" % (1000 * k) for k in range(20)) + b"\n1,2\n-1\nx\n")

    sender = threading.Thread(target=send)
    sender.start()
    try:
        sensor.open()
        seq = sensor.latest().seq
        until(lambda: sensor.latest().seq > seq + 2)
        assert sensor.latest().data.tolist()[3] == [15000, 16000, 17000, 18000, 19000]
        assert sensor.counters()["skipped_bytes"] > 0
    finally:
        ended.set()
        sender.join()
        sensor.close()
        port.unplug()
