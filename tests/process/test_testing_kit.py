"""Test the test kit with test files that run in a separate pytest process."""

import os
from pathlib import Path

import pytest

from softfinger.daemon.errors import HandClosed, SettingsError
from softfinger.daemon.simulation.emulator.folder import NoEmulator
from softfinger.daemon.simulation.faults import FaultError
from softfinger.testing import EmulatedBus, EmulatedHand, RecordedHand, VirtualHand, virtual
from tests.harness.daemon_process import plugin_path, python

SERVOS = """
import dynamixel_sdk as sdk
import pytest

OK = sdk.COMM_SUCCESS


class Patient(sdk.PortHandler):
    def setPacketTimeout(self, _):
        self.setPacketTimeoutMillis(60_000.0)  # a busy machine may take more than 34 ms


@pytest.fixture
def line(emulated_hand):
    port = Patient(emulated_hand.ports["servos"])
    assert port.openPort() and port.setBaudRate(1_000_000)
    yield port, sdk.PacketHandler(2.0)
    port.closePort()


def test_goals_and_faults(emulated_hand, line):
    port, packets = line
    assert packets.ping(port, 1) == packets.ping(port, 2) == (1020, OK, 0)
    write = sdk.GroupSyncWrite(port, packets, 116, 4)
    for servo in (1, 2):
        assert packets.write1ByteTxRx(port, servo, 64, 1) == (OK, 0)
        assert write.addParam(servo, [0x66, 8, 0, 0])  # 2150
    assert write.txPacket() == OK
    left, right = emulated_hand.report()["servos"]
    assert left["torque"] and right["torque"]
    assert left["goal_q"][0] == pytest.approx(102 * 2 * 3.14159 / 4096, rel=1e-3)
    emulated_hand.fault("silent=2", "left:silent")
    assert packets.ping(port, 1)[1] == OK
    port.setPacketTimeout = lambda _: port.setPacketTimeoutMillis(50.0)
    assert packets.ping(port, 2)[1] == sdk.COMM_RX_TIMEOUT
    del port.setPacketTimeout
    emulated_hand.fault("well")
    assert packets.ping(port, 2)[1] == OK
    assert emulated_hand.report(forget=True)["servos"][0]["torque_on"]["count"] == 1
    assert emulated_hand.report()["servos"][0]["torque_on"]["count"] == 0


def test_words(emulated_hand):
    from softfinger import Refused

    assert emulated_hand.send("press depth=1mm speed=100mm/s tip=left") == ""
    with pytest.raises(Refused, match="melted.*expected one of"):
        emulated_hand.fault("melted")
    assert set(emulated_hand.ports) == {"servos", "tactile-left", "tactile-right"}


@pytest.mark.softfinger(profile="small", ids="7,3", factory=True)
def test_other_servos(emulated_hand, line):
    port, packets = line
    assert packets.ping(port, 7) == packets.ping(port, 3) == (1200, OK, 0)
    assert packets.read1ByteTxRx(port, 7, 9) == (250, OK, 0)  # factory return delay
"""

HANDS = '''
import os
import subprocess
import sys

import pytest
from softfinger import Hand, NotInTime, Refused

CLIENT = """
import msgpack, os, sys, zmq
stream, commands = os.environ["SOFTFINGER_ADDRESS"].split(",")
context = zmq.Context()
states, asks = context.socket(zmq.SUB), context.socket(zmq.REQ)
states.connect(stream)
states.subscribe("hand/state")
asks.connect(commands)
def ask(**request):
    asks.send(msgpack.packb(request))
    return msgpack.unpackb(asks.recv())
assert ask(command="arm")["ok"]
assert ask(command="grasp", force=6.0)["ok"]
assert not ask(command="grasp", force=600.0)["ok"]
while msgpack.unpackb(states.recv_multipart()[1])["mode"] != "holding":
    pass
"""


class Steady:
    """Arm, and grip with 6 N."""

    def __init__(self):
        self.times = []

    def __call__(self, state):
        self.times.append(state.mono_ns * 1e-9)
        if state.mode == "disarmed":
            return {"command": "arm"}
        return {"command": "hold", "force": 6.0}


def test_a_callable(virtual_hand):
    steady, begin = Steady(), virtual_hand.t
    assert virtual_hand.run(2.0, steady) == []
    assert virtual_hand.t == pytest.approx(begin + 2.0, abs=0.002)
    assert len(steady.times) == pytest.approx(200, abs=2)
    assert virtual_hand.plant.force == pytest.approx([6.0, 6.0], rel=0.05)


def grip(hand):
    hand.arm()
    hand.grasp(force=6.0)
    return hand.wait_for(lambda state: state.mode == "holding", timeout=5.0)


def test_a_program_for_a_hand(virtual_hand):
    first = virtual_hand.state()
    assert grip(virtual_hand).seq > first.seq
    assert virtual_hand.plant.force == pytest.approx([6.0, 6.0], rel=0.1)
    assert len(virtual_hand.collect(0.5)) == 50
    frames = virtual_hand.frames()
    assert {next(frames).finger for _ in range(4)} == {"left", "right"}
    with pytest.raises(NotInTime, match="last state: mode holding"):
        virtual_hand.wait_for(lambda state: state.mode == "fault", timeout=0.1)
    with pytest.raises(Refused, match="600 N"):
        virtual_hand.grasp(force=600.0)
    assert virtual_hand.status()["mode"] == "holding"
    virtual_hand.stop()
    assert not virtual_hand.state().torque


def test_clients_over_zeromq(virtual_hand):
    with virtual_hand.serve(speed=2.0) as address:
        environment = {**os.environ, "SOFTFINGER_ADDRESS": address}
        subprocess.run([sys.executable, "-c", CLIENT], check=True, env=environment)
        with pytest.raises(RuntimeError, match="use a client"):
            virtual_hand.run(1.0)
        with Hand(address) as hand:
            state = hand.wait_for(lambda state: state.mode == "holding")
            assert state.left.force == pytest.approx(6.0, rel=0.2)
    begin = virtual_hand.t
    assert virtual_hand.state().mode == "holding"  # the time is ours again
    assert virtual_hand.t < begin + 0.03
    with virtual_hand.serve() as address, Hand(address) as hand:
        hand.stop()
        assert hand.state().mode == "disarmed"


@pytest.mark.softfinger(plant=["simulation.tactile_gain=[0.8, 0.8]"])
@pytest.mark.parametrize("word", ["", "push=2", "current=0.9@0.1..0.2"])
def test_the_same_calls_give_the_same_states(virtual_hand, word, request):
    from softfinger.testing import VirtualHand

    (marker,) = request.node.iter_markers("softfinger")
    with VirtualHand(**marker.kwargs) as other:
        for hand in (virtual_hand, other):
            hand.run(1.2, Steady())
            hand.fault(*filter(None, [word]))
            hand.run(0.3)
        assert virtual_hand.state() == other.state()
        assert virtual_hand.plant.object_pose.tolist() == other.plant.object_pose.tolist()


def test_the_plant_may_differ(virtual_hand, tmp_path):
    from softfinger.testing import VirtualHand

    with VirtualHand(plant=["simulation.modulus_scale=1.3"]) as other:
        for hand in (virtual_hand, other):
            hand.run(0.6, Steady())
        assert other.settings == virtual_hand.settings
        assert other.plant.d[0] < virtual_hand.plant.d[0]


def test_a_recording(virtual_hand, recorded_hand, tmp_path):
    with virtual_hand.record(tmp_path / "grip.mcap"):
        virtual_hand.run(0.1)
        reached = grip(virtual_hand)
    hand = recorded_hand(tmp_path / "grip.mcap")
    assert list(hand.stream())[-1] == reached
    hand = recorded_hand(tmp_path / "grip.mcap")
    seen = []
    hand.run(60.0, lambda state: seen.append(state.mode))
    assert seen[0] == "disarmed" and seen[-1] == "holding" and hand.sent == []
    hand = recorded_hand(tmp_path / "grip.mcap")
    hand.run(0.3, Steady())
    assert hand.t == pytest.approx(0.3, abs=0.02)
    assert {request["command"] for _, request in hand.sent} == {"arm", "hold"}
    with recorded_hand(tmp_path / "grip.mcap").serve() as address, Hand(address) as client:
        client.grasp(force=3.0)
        assert client.state().seq > 0


def test_a_controller_that_asks_for_nonsense(virtual_hand):
    with pytest.raises(TypeError, match="controller: found 3.0, expected None or a map"):
        virtual_hand.run(0.1, lambda state: 3.0)
    with pytest.raises(Refused, match="grapsp"):
        virtual_hand.run(0.1, lambda state: {"command": "grapsp"})
    refusals = virtual_hand.run(0.1, lambda state: {"command": "grasp", "force": 600.0})
    assert len(refusals) == pytest.approx(10, abs=1)
    assert "not accepted in mode disarmed" in str(refusals[0])


@pytest.mark.parametrize(
    "_",
    [
        pytest.param(0, marks=pytest.mark.softfinger(mass=1.0)),
        pytest.param(1, marks=pytest.mark.softfinger("velostat")),
    ],
)
@pytest.mark.xfail(strict=True, raises=TypeError)
def test_an_unknown_option(virtual_hand, _):
    pass
'''

IMPORTS = """
import sys


def test_little_is_loaded():
    heavy = ("numpy", "numba", "zmq", "msgpack", "softfinger.daemon", "softfinger.kinematics")
    assert not [name for name in sys.modules if name.startswith(heavy)]
"""


@pytest.mark.parametrize(
    ("text", "count"), [(SERVOS, 3), (HANDS, 9), (IMPORTS, 1)], ids=["servos", "hands", "imports"]
)
def test_user_tests_pass(tmp_path, text, count):
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "test_it.py").write_text(text, encoding="utf-8")
    # Other installed plugins import NumPy.
    options = ("-p", "no:cacheprovider", "-p", "no:hypothesispytest", "--strict-markers", "-q")
    environment = os.environ | {"PYTHONPATH": plugin_path(tmp_path / "site")}
    done = python("-m", "pytest", *options, folder, cwd=folder, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{count} passed" in done.stdout


def test_a_virtual_subscription_counts_and_closes_like_a_real_one(monkeypatch):
    monkeypatch.setattr(virtual, "_QUEUE", 5)
    hand = VirtualHand()
    states, closed = hand.stream(), hand.stream()
    before = hand.state()
    for _ in range(8):
        hand.state()
    assert (states.lost, states.unreadable) == (4, 0)
    assert repr(states) == f"VirtualSubscription: hand/state from {hand.stream_address}, 4 lost"
    assert next(states).seq > before.seq
    closed.close()
    for use in (closed.skip, lambda: closed.next(None)):
        with pytest.raises(HandClosed, match="this subscription is closed"):
            use()
    hand.close()
    for use in (hand.state, hand.step, lambda: hand.run(0.1), lambda: next(states)):
        with pytest.raises(HandClosed, match="is closed: create a new one"):
            use()


def test_recordings_are_closed(tmp_path):
    path = tmp_path / "run.mcap"
    with VirtualHand() as hand, hand.record(path):
        other = hand.record(tmp_path / "other.mcap")
        with pytest.raises(RuntimeError, match="found a recording in progress"), other:
            pass
        hand.run(0.3)
    with RecordedHand(path) as played:
        played.run(0.2)
        assert path in (each.resolve() for each in Path("/proc/self/fd").iterdir())
    assert path not in (each.resolve() for each in Path("/proc/self/fd").iterdir())


def test_unusable_hands_and_faults_are_refused(capfd):
    with pytest.raises(
        NoEmulator, match=r"--model=AX-12: the program exited; see its message above"
    ):
        EmulatedHand(model="AX-12")
    assert "XM430-W350" in capfd.readouterr().err
    with pytest.raises(SettingsError, match="hil: found hardware backends, expected simulat"):
        VirtualHand("hil")
    for count in (0, 9):
        with pytest.raises(ValueError, match=f"ids: found {count} servos, expected 1 to 8"):
            EmulatedBus(ids=range(count))
    with EmulatedBus(ids=[4]) as bus, VirtualHand() as hand:
        for word in ("left:silent", "drop=1@2"):
            with pytest.raises(FaultError, match="expected"):
                bus.fault(word)
        for word in ("left:silent", "frozen@0.5", "drop=1@2", "right:plug@2"):
            with pytest.raises(FaultError, match=f"fault '{word}': found a servo or board fault"):
                hand.fault("gain=2@1", word)
        assert not hand._faults
        hand.fault("twist=0.1", "gain=2@1", "left:well@2", "well")
        assert [event.after - hand.t for event in hand._faults] == pytest.approx([1, 1, 2])
        with pytest.raises(FaultError, match="no servo has this ID"):
            bus.fault("silent=3")
        assert Path(bus.port).is_char_device()
        bus.fault("unplug")
        bus.fault("well")
        assert Path(bus.port).is_char_device()
        (servo,) = bus.report()
        assert (servo["id"], servo["torque"]) == (4, False)
