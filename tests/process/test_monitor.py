"""Test the monitor in a separate process with a pseudo-terminal and real sockets."""

import json
import math
import os
import signal
import sys
import termios
from pathlib import Path

import msgpack
import pytest

from softfinger import Hand
from tests.conftest import until
from tests.harness.daemon_process import SOFTFINGER, started
from tests.harness.descendants import ending
from tests.harness.fake_daemon import FakeDaemon, finger
from tests.harness.terminal_process import TerminalProcess

NOBODY = "tcp://127.0.0.1:1"  # address without a daemon


def command(fake: FakeDaemon, *more: str) -> list[str]:
    where = f"{fake.state_address},{fake.command_address}"
    return [*SOFTFINGER, "monitor", "--address", where, *more]


def test_page_shows_the_hand_and_the_state_of_its_stream(fake):
    with TerminalProcess(command(fake)) as page:
        fake.send_event("mode", "before the page was there")
        page.shows("HOLDING", "● live", "LEFT contact", "RIGHT contact", "kPa", "▀" * 22)
        page.shows("3.21±0.02", "3.31±0.02", "±0.10", "12.34", "24.06", "0.213", "0.350")
        page.shows("4.98 °", "40.00 mm wide", "overruns 0")
        fake.send_event("mode", "grasping → holding")
        page.shows("grasping → holding")
        bright = {page.screen.buffer[y][x].fg for y in range(3, 14) for x in range(22)}
        assert len(bright) > 10  # The footprint has many colours.
        fake.changes = {"mode": "fault", "fault": "left: no frame for 0.1 s"}
        page.shows("FAULT left: no frame for 0.1 s", "c clears it")
        fake.silent.set()
        # The page shows the stream as stale for up to 1.5 s, and then as lost.
        page.shows("○ lost", "the stream has stopped")
        fake.changes = {}
        fake.silent.clear()
        page.shows("● live", "HOLDING")
        assert "has stopped" not in page.text()


@pytest.mark.parametrize("how", ["ctrl-c", "hup", "exception", "duration"])
def test_terminal_is_restored(fake, how):
    call = command(fake, *(["--duration", "1.2"] if how == "duration" else []))
    if how == "exception":
        call[1:4] = ["-c", BREAKS_AT_THE_TENTH_PAGE]
    with TerminalProcess(call) as page:
        if how not in ("exception", "duration"):
            page.shows("HOLDING")
            assert termios.tcgetattr(page.slave) != page.attributes
            assert not page.is_restored()
        if how == "ctrl-c":
            page.type(b"\x03")
        elif how == "hup":
            page.process.send_signal(signal.SIGHUP)
        assert page.ended() == (1 if how == "exception" else 0)
        assert page.is_restored()
        after = page.written[page.written.rfind(b"\x1b[?1049l") :]
        # The traceback is printed on the main screen.
        assert (b"the tenth page" in after) == (how == "exception")


BREAKS_AT_THE_TENTH_PAGE = """
import argparse, sys
from softfinger.tools.terminal import monitor
from softfinger.tools.terminal import monitor_page
whole, count = monitor_page.MonitorPage.lines, 0
def lines(*arguments):
    global count
    count += 1
    if count == 10:
        raise RuntimeError("the tenth page")
    return whole(*arguments)
monitor_page.MonitorPage.lines = lines
parser = argparse.ArgumentParser()
monitor.add_arguments(parser)
sys.exit(monitor.run(parser.parse_args()))
"""


def test_a_signal_ends_it_while_the_terminal_is_blocked(fake):
    with TerminalProcess(command(fake)) as page:
        page.shows("HOLDING")
        termios.tcflow(page.slave, termios.TCOOFF)  # Suspend the output as Ctrl-S does.
        # Wait for several redraws of the maps.
        until_later = fake.published + 50
        until(lambda: fake.published >= until_later)
        page.process.terminate()
        assert page.ended() == 0
        assert page.is_restored()


def test_keys_command_the_hand(fake):
    fake.replies["clear"] = {"ok": False, "error": "clear: not accepted in mode holding"}
    fake.replies["arm"] = b"not what a reply is"
    with TerminalProcess(command(fake, "--client", "bench")) as page:
        page.shows("HOLDING")
        for key, sent, shown in (
            (b"g", {"command": "grasp"}, "✓ grasp: ok"),
            (b"c", {"command": "clear"}, "✗ clear: not accepted in mode holding"),
            (b"r", {"command": "release"}, "✓ release: ok"),
            (b"a", {"command": "arm"}, "sent an invalid reply"),
            (b"w", {"command": "demo"}, "✓ demo: ok"),
            (b" ", {"command": "stop"}, "✓ stop: ok"),
        ):
            page.type(key)
            page.shows(shown)
            assert fake.requests[-1] == sent | {"client": "bench"}
        page.type(b"d")
        page.shows("✗ disarm: the object would fall; press d again to disarm")
        assert fake.requests[-1]["command"] == "stop"
        # A slow machine may read these keys more than 3 s after the first d. Then the first of them
        # is refused again, and the second one confirms it.
        page.type(b"dd")
        page.shows("✓ disarm: ok")
        page.type(b"?")
        page.shows("tilt of the object's face", "q quit")
        page.type(b"?")
        page.shows("LEFT contact")
        page.type(b"\x1b[C")
        page.shows("✓ rotate to 10.0°")
        # The second key press adds 5° to the last target, not to the measured angle of 4.98°.
        fake.changes = {"goal_angle": fake.requests[-1]["angle"]}
        page.shows("object angle 10.0°")
        page.type(b"\x1b[C")
        page.shows("✓ rotate to 15.0°")
        fake.changes = {"goal_angle": fake.requests[-1]["angle"]}
        page.shows("object angle 15.0°")
        page.type(b"\x1bOD")
        page.shows("✓ rotate to 10.0°")
        assert [r["command"] for r in fake.requests[-3:]] == ["rotate"] * 3
        assert fake.requests[-1]["angle"] == pytest.approx(0.17418, abs=1e-4)
        fake.replies["rotate"] = {"ok": False, "error": "rotate: angle: too much"}
        # After a refused turn, the next turn starts at the measured object angle.
        for _ in range(2):
            count = len(fake.requests)
            page.type(b"\x1b[D")
            page.wait(lambda count=count: len(fake.requests) > count)
            page.shows("✗ rotate: angle: too much")
        assert fake.requests[-1]["angle"] == pytest.approx(-0.00035, abs=1e-4)
        count = len(fake.requests)
        # The page ignores pasted text and unused keys.
        page.type(b"\x1b[200~gado \x1b[201~zZ\x1b[A\x1b[15~")
        page.type(b" ")
        page.shows("✓ stop: ok")
        assert [r["command"] for r in fake.requests[count:]] == ["stop"]
        fake.replies["stop"] = {"ok": True, "mode": "disarmed", "torque_off": "unconfirmed"}
        page.type(b" ")
        page.shows("✗ stop: the servos have not yet confirmed that torque is off")


SETTINGS = {"control": {"force_default": 10.0}, "safety": {"force_max": 14.0}}


def test_the_grasp_force_is_selected_and_updates_a_grip(fake):
    def asked() -> list[object]:
        return [each.get("force") for each in fake.requests]

    with TerminalProcess(command(fake)) as page:
        page.shows("HOLDING", "+- 10 N", "grip: goal 10.0 N, object angle 5.0°")
        fake.changes = {"mode": "armed", "goal_force": math.nan, "goal_angle": math.nan}
        page.shows("ARMED", "+- N")
        page.type(b"+")
        page.shows("settings have not arrived yet")
        assert "grip:" not in page.text()
        fake.send(b"hand/settings", msgpack.packb({"settings": json.dumps(SETTINGS)}))
        page.shows("+- 10 N")
        page.type(b"++")
        page.shows("+- 12 N")
        page.type(b"+")
        page.shows("+- 12.6 N")  # The maximum is 0.9 of the force limit.
        page.type(b"-" * 10)
        page.shows("+- 4 N")  # Below 5 N, the steps are smaller.
        assert fake.requests == []
        page.type(b"g")
        page.shows("✓ grasp with 4 N: ok")
        assert asked() == [4.0]
        # During a grip, the keys change the last commanded force, even if another client commanded
        # it.
        fake.changes = {"goal_force": 9.0}
        page.shows("HOLDING", "+- 9 N")
        told = {"command": "grasp", "client": "", "request": '{"force": 7.0}', "ok": True}
        fake.send(b"hand/command", msgpack.packb(told))
        page.shows("+- 7 N", "raised from 7.0 N")
        page.type(b"--")
        page.shows("✓ grasp with 5 N: ok")
        assert asked() == [4.0, 6.0, 5.0]


def test_a_late_command_is_repeated_with_its_key(fake):
    late = {
        "ok": False,
        "error": "arm: the command was 0.40 s old when it was processed",
        "reason": "late",
    }
    fake.replies["arm"] = [late, late, {"ok": True}]
    fake.changes = {"mode": "disarmed"}
    with TerminalProcess(command(fake)) as page:
        page.shows("DISARMED")
        page.type(b"a")
        page.shows("✓ arm: ok")
    assert [each["command"] for each in fake.requests] == ["arm"] * 3
    assert len(set(fake.keys)) == 1


@pytest.mark.extended
def test_the_page_shows_another_commander_of_a_real_daemon(start, profile, addresses):
    stream, commands = addresses
    daemon = start("--config", str(profile("commands.lease = 60.0\n")))
    where = ["--address", f"{stream},{commands}"]
    with TerminalProcess([*SOFTFINGER, "monitor", *where]) as page:
        # The daemon published this event before the page was opened.
        page.shows("DISARMED", "running, disarmed")
        page.shows("compute", "late", "25.0", "°C")
        with Hand(stream, commands, client="notebook", timeout=60.0) as hand:
            hand.arm()
            page.shows("ARMED", "notebook commands the hand")
            page.type(b"g")
            page.shows("✗ grasp: notebook holds the lease for another")
            page.type(b" ")  # A stop requires no lease.
            page.shows("✓ stop: ok", "DISARMED")
        assert daemon.end() == 0
        page.shows("○ lost")


def test_commands_without_a_daemon():
    where = ["--address", NOBODY]
    with TerminalProcess([*SOFTFINGER, "monitor", *where]) as page:
        page.shows("waiting for a daemon", "waiting for the stream", "—")
        page.type(b"a" * 12 + b" ")
        page.shows("stop: no reply")
        page.type(b"\x1b[C")
        page.shows("rotate: the object's angle is unknown")
        page.type(b"q")
        assert page.ended() == 0


def test_unreadable_messages_are_counted_and_harmless(fake):
    with TerminalProcess(command(fake)) as page:
        page.shows("HOLDING")
        fake.send(b"hand/state", b"\xc1")
        fake.send(b"hand/tactile", msgpack.packb({"finger": "left", "rows": 4, "cols": 4}))
        page.shows("2 unreadable", "HOLDING")
        fake.changes = {"mode": 3, "left": "no", "object": None, "overruns": "x", "schema": 9}
        page.shows("schema 9", "—")
        fake.changes = {}
        page.shows("HOLDING", "● live")
        fake.send_event("odd", "\x1b[2Jescape\x07 and\nnewline")
        page.shows("[2Jescape  and newline")
        assert b"\x07" not in page.written


def test_resize_suspend_and_continue(fake):
    with TerminalProcess(command(fake), 120, 40) as page:
        page.shows("HOLDING", "▀" * 42)
        page.resize(60, 20)
        page.process.send_signal(signal.SIGWINCH)
        page.shows("requires 80 × 24", "this terminal: 60 × 20")
        page.type(b" ")
        page.wait(lambda: fake.requests == [{"command": "stop"}])
        page.resize(80, 24)
        page.shows("HOLDING", "q quit")
        page.type(b"\x1a")
        status = Path(f"/proc/{page.process.pid}/stat")
        page.wait(lambda: status.read_text().rsplit(")", 1)[1].split()[0] == "T")
        assert page.is_restored()
        page.screen.reset()
        page.process.send_signal(signal.SIGCONT)
        page.shows("HOLDING", "kPa")
        page.type(b"q")
        assert page.ended() == 0
        assert page.is_restored()


def test_plain_lines_through_a_pipe(fake):
    fake.changes = {"left": finger(0.0, 0) | {"force": 12.34}}
    with ending(started(*command(fake)[3:])) as plain:
        lines: list[str] = []
        while sum(" holding " in line for line in lines) < 2:
            lines.append(plain.stdout.readline())
            assert lines[-1], plain.stderr.read()
            if " holding " in lines[-1]:
                fake.send_event("mode", "grasping → holding", "warning")
        text = "".join(lines)
        assert "\x1b" not in text
        assert "(12.3 ± 0.1, " in text
        assert "), 5.0°, 40.0 mm" in text
        assert any("warning mode: grasping → holding" in line for line in lines)
        plain.stdout.close()  # The reader has closed the pipe.
        assert plain.wait(300.0) == 0
        assert plain.stderr.read() == ""


@pytest.mark.extended
def test_no_wait_exits_without_a_stream_and_when_the_stream_ends(fake):
    where = ["--address", NOBODY, "--no-wait"]
    with TerminalProcess([*SOFTFINGER, "monitor", *where]) as page:
        assert page.ended() == 1
        assert page.is_restored()
        assert f"no stream from {NOBODY} within 5 s" in page.written.decode()
    with TerminalProcess(command(fake, "--no-wait")) as page:
        page.wait(lambda: b"HOLDING" in page.written)  # The process may already have exited.
        fake.silent.set()
        assert page.ended() == 0
        assert page.is_restored()
        assert b"the stream has ended" in page.written


# Together with a daemon

DAEMON = """
import signal, sys, threading
from softfinger.tools.processes.child_processes import MonitorProcess
over = threading.Event()
signal.signal(signal.SIGINT, lambda *_: over.set())
with MonitorProcess(sys.argv[1], sys.argv[2], on_end=over.set) as page:
    open(sys.argv[3], "w").write(str(page.process.pid))
    over.wait(300.0)
print("ended", over.is_set(), flush=True)
"""


class Beside(TerminalProcess):
    """A stand-in for the daemon, which runs the monitor as its child process."""

    def __init__(self, fake: FakeDaemon, folder: Path) -> None:
        file = folder / "pid"
        addresses = [fake.state_address, fake.command_address]
        super().__init__([sys.executable, "-c", DAEMON, *addresses, str(file)])
        self.shows("HOLDING")
        until(lambda: file.exists() and file.read_text())
        self.child = int(file.read_text())

    def child_is_gone(self) -> bool:
        self.pump()
        try:
            return Path(f"/proc/{self.child}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
        except FileNotFoundError:
            return True


@pytest.mark.parametrize("how", ["interrupt", "the daemon is killed", "the page is killed"])
def test_either_end_ends_both_and_restores_the_terminal(fake, tmp_path, how):
    with Beside(fake, tmp_path) as page:
        if how == "interrupt":
            page.type(b"\x03")
        else:
            os.kill(page.process.pid if "daemon" in how else page.child, signal.SIGKILL)
        if "daemon" not in how:
            assert page.ended() == 0
        page.wait(page.child_is_gone)
        assert page.is_restored()
        assert (b"ended True" in page.written) == ("daemon" not in how)


def test_the_page_has_lower_priority_and_quitting_it_ends_both(fake, tmp_path):
    with Beside(fake, tmp_path) as page:
        assert os.getpriority(os.PRIO_PROCESS, page.child) == min(
            os.getpriority(os.PRIO_PROCESS, page.process.pid) + 5, 19
        )
        # The page ignores Ctrl-Z here, because suspending the daemon would leave torque on.
        page.type(b"\x1a")
        page.type(b"q")
        assert page.ended() == 0
        assert page.is_restored()
        after = page.written[page.written.rfind(b"\x1b[?1049l") :]
        assert b"ended True" in after
