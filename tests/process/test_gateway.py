"""Test that the loop continues when the gateway hangs, crashes or is killed; test local stops."""

import asyncio
import json
import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import msgpack
import psutil
import pytest
import zmq

from softfinger import AsyncHand, Hand
from softfinger.daemon.client import command_client
from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.errors import AddressError
from softfinger.daemon.gateway import bounds, supervisor
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.server import Server
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import local_stop, loop_link
from softfinger.daemon.wire.local_stop import LocalStop, stop_locally
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, Publisher
from tests.conftest import Addresses, until
from tests.harness.daemon_process import ask, python
from tests.harness.terminal_process import TerminalProcess
from tests.process.test_untrusted_clients import place


@pytest.fixture
def own_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Create a runtime folder whose path is short enough for a Unix socket."""
    with TemporaryDirectory(prefix="softfinger-") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder) / "softfinger"


@pytest.fixture
def gateway(addresses: Addresses) -> Iterator[Gateway]:
    """Yield a gateway process without a loop."""
    with closing(Gateway(Config(*addresses, GATEWAY_TOPICS, 100))) as gateway:
        gateway.wait()
        yield gateway


@pytest.fixture
def ticking(addresses: Addresses, own_folder: Path) -> Iterator[Daemon]:
    """Yield a daemon whose loop runs in a thread and whose gateway runs in a separate process."""
    settings = Settings.model_validate(
        {
            "stream": {"address": addresses[0]},
            "commands": {"address": addresses[1]},
            "safety": {"overruns_fault": 10**6},
        }
    )
    with Daemon(settings) as daemon:
        thread = threading.Thread(target=daemon.loop.run)
        thread.start()
        yield daemon
        daemon.loop.end()
        thread.join()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_crashed_gateway_is_restarted_while_the_loop_continues(ticking, addresses, number):
    gateway, loop = ticking.gateway, ticking.loop
    with Hand(*addresses, timeout=60.0) as hand:
        hand.arm()
        stream = hand.stream(timeout=60.0)
        next(stream)
        first, ticks = gateway.process.pid, loop.state.seq
        os.kill(first, number)
        until(lambda: gateway.process.pid != first)
        # Clients reconnect by themselves and receive the events that they missed.
        with hand.events(timeout=60.0) as told:
            assert any(f"exited (signal {number})" in event.text for event in told)
        stream.skip()
        state = next(stream)
        assert state.mode == "armed"
        assert state.seq > ticks
        assert ask(addresses[1], "status")["torque"] is True


def test_early_subscribers_of_a_new_gateway_receive_past_events(addresses, context):
    link = loop_link.Link()
    Publisher(link).event(0.0, 0.0, "info", "test", "while there was no gateway")
    ours, theirs = loop_link.pair()
    here = loop_link.Channel(ours)
    server = Server(loop_link.Channel(theirs), Config(*addresses, GATEWAY_TOPICS, 100))
    subscriber = context.socket(zmq.SUB)
    subscriber.subscribe(b"hand/event")
    subscriber.connect(addresses[0])

    def subscribed() -> bool:
        server.step(0.0)
        reports = [wanted for _, wanted, *_ in here.receive()]
        return bool(reports and reports[-1])

    try:
        until(subscribed)
        link.offer(here)
        link.look()
        until(lambda: [server.step(0.0), subscriber.poll(1)][1])
        event = msgpack.unpackb(subscriber.recv_multipart()[1])
        assert (event["text"], event["again"]) == ("while there was no gateway", True)
    finally:
        link.close()
        server.close()


def test_the_gateway_ends_with_its_daemon(profile, addresses, start):
    running = start("--config", str(profile()))
    (gateway,) = psutil.Process(running.process.pid).children()
    running.process.kill()
    running.process.wait()
    assert psutil.wait_procs([gateway], timeout=300.0)[1] == []


HANGING = """
import select, sys
from softfinger.daemon.gateway import bounds, server as gateway
from softfinger.daemon.gateway.server import Server

bounds.{bound} = 0.1
step = Server.step

def first(server):
    step(server)
    Server.step = second

def second(server):
    {does}
    server.channel.over = True

Server.step = first
sys.exit(gateway.main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("bound", "does", "status"),
    [
        ("STEP_CPU_TIME_MAX", "while True: pass", -signal.SIGPROF),
        ("STEP_TIME_MAX", "select.select([], [], [])", -signal.SIGALRM),
        # Suspend the gateway like a process that gets no processor time.
        ("STEP_CPU_TIME_MAX", "select.select([], [], [], 0.5)", 0),
    ],
)
def test_a_hanging_gateway_ends_itself_but_not_on_a_busy_machine(bound, does, status):
    ours, theirs = loop_link.pair()
    with ours, theirs:
        config = json.dumps(Config("", "", GATEWAY_TOPICS, 100))
        script, link = HANGING.format(bound=bound, does=does), theirs.fileno()
        ended = python("-c", script, link, config, pass_fds=(link,))
    assert ended.returncode == status


def test_a_stopped_gateway_is_replaced(gateway):
    stopped = gateway.process.pid
    os.kill(stopped, signal.SIGSTOP)
    until(lambda: gateway.process.pid != stopped)
    assert "the gateway process was suspended" in gateway.link.notices


def test_gateway_memory_is_bounded_and_its_priority_is_normal(gateway):
    limits = Path(f"/proc/{gateway.process.pid}/limits").read_text(encoding="ascii")
    (data,) = [line for line in limits.splitlines() if line.startswith("Max data size")]
    assert int(data.split()[3]) <= bounds.MEMORY_MAX
    (files,) = [line for line in limits.splitlines() if line.startswith("Max open files")]
    assert int(files.split()[3]) <= bounds.CLIENT_COUNT_MAX + bounds.DESCRIPTOR_COUNT
    assert os.sched_getscheduler(gateway.process.pid) == os.SCHED_OTHER


def test_a_loop_with_a_stopped_gateway_drops_messages_without_waiting(gateway):
    publisher = Publisher(gateway.link)
    gateway.link.look()
    os.kill(gateway.process.pid, signal.SIGSTOP)
    for k in range(50_000):  # If publishing waited for the gateway, the loop would never end.
        publisher.event(0.0, 0.0, "info", "test", f"event {k}")
    assert len(gateway.link._channel._unsent) < 1000, "the queue exceeds its limit"
    with suppress(ProcessLookupError):  # The daemon may already have killed a slow gateway.
        os.kill(gateway.process.pid, signal.SIGCONT)


# --- local stop -----------------------------------------------------------------------------------

# Run a subcommand that waits longer for a local stop, because a busy machine may reply late.
PATIENT = """
import sys
from softfinger.daemon.client import command_client
from softfinger.tools import cli
from softfinger.tools.terminal import stream_state
command_client.LOCAL_STOP_TIMEOUT = stream_state.REPLY_TIMEOUT = 60.0
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_local_stop_works_when_all_client_slots_are_used(ticking, addresses, inline, monkeypatch):
    # Prevent the daemon from replacing the stopped gateway, and allow a busy machine enough time
    # for a local stop.
    monkeypatch.setattr(supervisor, "_SUSPENSION_TIME_MAX", threading.TIMEOUT_MAX)
    monkeypatch.setattr(command_client, "LOCAL_STOP_TIMEOUT", 60.0)
    where = ["--address", ",".join(addresses)]
    with (
        Hand(*addresses, timeout=60.0) as hand,
        TerminalProcess([sys.executable, "-c", PATIENT, "monitor", *where]) as page,
    ):
        hand.arm()
        page.shows("ARMED")
        # A stopped gateway does not serve clients.
        os.kill(ticking.gateway.process.pid, signal.SIGSTOP)
        try:
            assert send(addresses[1], {"command": "stop"}, timeout=60.0)["ok"] is True
            assert ticking.loop.state.mode == "disarmed"

            async def stop() -> bool:
                async with AsyncHand(*addresses, timeout=60.0) as other:
                    return bool(await other.command("stop"))

            assert asyncio.run(stop())
            done = inline("send", "stop", "--address", addresses[1], "--timeout", "60")
            assert (done.returncode, '"ok": true' in done.stdout) == (0, True), done.stderr
            page.type(b" ")
            page.shows("✓ stop: ok")
            with pytest.raises(NoAnswer):
                send(addresses[1], {"command": "status"}, timeout=0.2)
        finally:
            os.kill(ticking.gateway.process.pid, signal.SIGCONT)
        assert hand.wait_for(lambda state: not state.torque, 60.0).mode == "disarmed"
        hand.stop()
        hand.arm()  # From now on, all commands reach the gateway.
        hand.stop()


def test_the_local_socket_is_private_to_the_user(own_folder, addresses):
    local = LocalStop(addresses[1])
    host, port = place(addresses[1])
    assert stat.S_IMODE(own_folder.stat().st_mode) == 0o700
    assert stat.S_IMODE((own_folder / f"stop-{host}-{port}").stat().st_mode) == 0o600
    with pytest.raises(AddressError, match="is another softfinger running"):
        LocalStop(addresses[1])
    local.close()
    assert list(own_folder.iterdir()) == []


def test_a_folder_that_others_can_write_to_is_refused(own_folder, addresses, monkeypatch, tmp_path):
    own_folder.mkdir()
    own_folder.chmod(0o777)
    monkeypatch.setattr(local_stop, "socket_folders", lambda: iter([own_folder]))
    with pytest.raises(AddressError, match="other users can write to it"):
        LocalStop(addresses[1])
    own_folder.rmdir()
    own_folder.symlink_to(tmp_path)
    with pytest.raises(AddressError, match="found a link or a file, expected a folder"):
        LocalStop(addresses[1])
    assert stop_locally(addresses[1], 0.1) is None


def test_the_socket_of_a_killed_daemon_is_replaced(own_folder, addresses):
    killed = LocalStop(addresses[1])
    killed._socket.close()
    assert stop_locally(addresses[1], 0.1) is None
    LocalStop(addresses[1]).close()


def test_a_stop_for_another_machine_has_no_effect_here(own_folder, addresses):
    local = LocalStop(addresses[1])
    for host in ("hand.example", "192.0.2.1", "127.0.0.2"):
        assert stop_locally(f"tcp://{host}:{place(addresses[1])[1]}", 0.1) is None
    assert not local.take()
    local.close()


@pytest.mark.parametrize(
    ("bound", "asked"),
    [
        ("tcp://192.0.2.1:9873", "tcp://192.0.2.1:9873"),
        ("tcp://[::1]:9873", "tcp://[::1]:9873"),
        ("tcp://0.0.0.0:9873", "tcp://localhost:9873"),
    ],
)
def test_a_local_stop_reaches_the_daemon_at_its_command_address(own_folder, bound, asked):
    local = LocalStop(bound)
    assert stop_locally(asked, 0.01) is None, "a stop must not be confirmed before it is read"
    assert local.take()
    local.close()


def test_a_loop_that_ends_while_its_gateway_starts_raises_no_error(addresses):
    ours, theirs = loop_link.pair()
    config = Config(*addresses, GATEWAY_TOPICS, 10, 200, 10.0, 0o600, "")
    with ours, theirs:
        words = ["-m", "softfinger.daemon.gateway.server", str(theirs.fileno()), json.dumps(config)]
        process = subprocess.Popen(
            [sys.executable, *words], pass_fds=(theirs.fileno(),), stderr=subprocess.PIPE
        )
    assert process.communicate()[1] == b""
    assert process.returncode == 0
