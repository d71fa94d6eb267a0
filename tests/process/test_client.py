"""Test the Python client against a real daemon, and against streams that no daemon would send."""

import asyncio
import inspect
import json
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from softfinger import (
    AsyncHand,
    Hand,
    HandFault,
    HandState,
    NoAnswer,
    NoStream,
    NotInTime,
    Refused,
    WrongThread,
)
from softfinger.daemon.client import command_client, connection
from softfinger.daemon.client import stream as stream_module
from softfinger.daemon.client.asynchronous import AsyncSubscription
from softfinger.daemon.client.command_client import UNCONFIRMED_TEXT
from softfinger.daemon.client.connection import still_waiting
from softfinger.daemon.client.hand import Subscription
from softfinger.daemon.client.stream import Gaps, read, to_columns
from softfinger.daemon.errors import HandClosed, SettingsError
from softfinger.daemon.types import COMMAND_ADDRESS, STREAM_ADDRESS
from softfinger.daemon.wire.schema import Event, TactileFrame
from tests.conftest import until
from tests.harness import fake_daemon
from tests.harness.daemon_process import python
from tests.harness.fake_daemon import FakeDaemon


@pytest.fixture
def hand(fake: FakeDaemon) -> Iterator[Hand]:
    with Hand(fake.state_address, fake.command_address, timeout=60.0) as hand:
        yield hand


def test_grasp_turn_and_release_on_a_running_daemon(daemon):
    with Hand(*daemon.addresses, timeout=60.0) as hand:
        assert hand.state().mode == "disarmed"
        with pytest.raises(Refused, match="grasp: not accepted in mode disarmed; arm first"):
            hand.grasp(force=5.0)
        hand.arm()
        with hand.events(timeout=60.0) as events, hand.frames(timeout=60.0) as frames:
            hand.grasp(force=5.0)
            held = hand.wait_for(lambda state: state.mode == "holding", 60.0)
            assert held.left.contact
            assert held.right.contact
            frame = next(frames)
            assert frame.counts.shape == (44, 44)
            assert frame.pressure.sum() > 0.0
            assert any("grasping" in event.text for event in events)
        hand.rotate(angle=math.radians(5.0))
        hand.wait_for(lambda state: abs(state.object.angle - math.radians(5.0)) < 5e-3, 60.0)
        states = hand.collect(0.3)
        columns = to_columns(states)
        assert np.all(np.diff(columns["seq"]) > 0)
        assert columns["left.force"].mean() == pytest.approx(5.0, rel=0.1)
        assert hand.status()["torque"] is True
        hand.stop()
        assert hand.wait_for(lambda state: not state.torque, 60.0).mode == "disarmed"


def test_grasp_turn_and_release_with_asyncio(daemon):
    async def session() -> tuple[str, int]:
        async with AsyncHand(*daemon.addresses, timeout=60.0) as hand:
            await hand.arm()
            with pytest.raises(Refused, match="expected a number"):
                await hand.grasp(force="much")
            await hand.grasp(force=5.0)
            assert (await hand.status())["torque"] is True
            held = await hand.wait_for(lambda state: state.mode == "holding", 60.0)
            async with hand.frames() as frames:
                seen = (await frames.next(60.0)).counts.size
            states = await hand.collect(0.1)
            assert [each.seq for each in states] == sorted({each.seq for each in states})
            await hand.arm()  # The hand is already armed.
            assert (await hand.state()).mode == "holding"
            arrived: list[HandState] = []
            hand._now = lambda: 20.0 * len(arrived)  # Each state takes 20 s.
            with pytest.raises(NotInTime, match="not met within 60 s; last state: mode holding"):
                await hand.wait_for(arrived.append, 60.0)
            assert len(arrived) == 3
            return held.mode, seen

    assert asyncio.run(session()) == ("holding", 44 * 44)


def test_a_fault_ends_a_wait(fake, hand):
    hand.state()
    fake.changes = {"mode": "fault", "fault": "servo 1: overload"}
    with pytest.raises(HandFault, match="servo 1: overload"):
        hand.wait_for(lambda state: state.mode == "holding" and not state.fault, 60.0)
    assert hand.wait_for(lambda state: state.mode == "fault", 60.0).fault == "servo 1: overload"


def test_a_wait_times_out_with_the_last_state(hand):
    arrived: list[HandState] = []
    hand._now = lambda: 20.0 * len(arrived)  # Each state takes 20 s.
    with pytest.raises(NotInTime, match="not met within 60 s; last state: mode holding"):
        hand.wait_for(arrived.append, 60.0)  # `append` returns None, so the condition is never met.
    assert len(arrived) == 3


def test_waiting_for_a_daemon_names_the_awaited_data(addresses, caplog, monkeypatch):
    for module in (command_client, stream_module):
        monkeypatch.setattr(module, "SILENCE_TIME", 0.05)
    stream, commands = addresses
    timeout = 0.5
    unanswered = rf"no reply to arm from {commands} within 0\.5 s"

    async def ask() -> None:
        async with AsyncHand(*addresses, timeout=timeout) as hand:
            with pytest.raises(NoStream):
                await hand.state()
            with pytest.raises(NoAnswer, match=unanswered):
                await hand.command("arm")

    with Hand(*addresses, timeout=timeout) as hand:
        with pytest.raises(NoStream, match=r"no hand/state from tcp://.* within 0\.5 s; is softf"):
            hand.state()
        with pytest.raises(NoAnswer, match=unanswered):
            hand.arm()
    asyncio.run(ask())
    said = [
        f"no hand/state from {stream} yet; waiting up to 0.5 s",
        f"no reply to arm from {commands} yet; waiting up to 0.5 s",
    ]
    assert caplog.messages == said + said


def test_a_negative_timeout_has_expired(addresses):
    with Hand(*addresses) as hand, pytest.raises(NoStream):
        hand.state(timeout=-1.0)

    async def ask() -> None:
        async with AsyncHand(*addresses) as hand:
            with pytest.raises(NoStream):
                await asyncio.wait_for(hand.state(timeout=-1.0), 60.0)

    asyncio.run(ask())


def test_an_infinite_timeout_waits_for_the_first_message(fake, monkeypatch):
    for module in (command_client, stream_module):
        monkeypatch.setattr(module, "SILENCE_TIME", 0.0)
    with Hand(fake.state_address, fake.command_address, timeout=math.inf) as hand:
        assert hand.state().mode == "holding"
        hand.arm()


def test_the_displayed_waiting_time_is_rounded():
    assert still_waiting("state", 9.99947).endswith("waiting up to 10 s")
    assert still_waiting("state", 86400.0).endswith("waiting up to 86400 s")


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        (np.float32(0.5), 0.5),
        (np.float64(0.1), 0.1),
        (np.int64(3), 3.0),
        (np.uint8(3), 3.0),
        (np.array(0.25), 0.25),
        (np.array(2), 2.0),
        (Fraction(1, 4), 0.25),
        (5, 5.0),
    ],
)
def test_all_number_types_are_sent_as_numbers(fake, hand, given, sent):
    hand.grasp(force=given)
    assert fake.requests[-1] == {"command": "grasp", "force": sent}
    asyncio.run(grasp_async(fake, given))
    assert fake.requests[-1] == {"command": "grasp", "force": sent}


async def grasp_async(fake: FakeDaemon, force: Any) -> None:
    async with AsyncHand(fake.state_address, fake.command_address, timeout=60.0) as hand:
        await hand.grasp(force=force)


@pytest.mark.parametrize(
    "given",
    [True, np.bool_(True), "5", np.array([5.0]), [5.0], 1j, np.array("5"), 10**400, object(), b"5"],
)
def test_a_value_that_is_not_a_number_is_refused_by_parameter_name(fake, hand, given):
    with pytest.raises(Refused, match="hold: angle: expected a number, found") as caught:
        hand.hold(force=5.0, angle=given)
    assert caught.value.reason == "request"
    with pytest.raises(Refused, match="grasp: force: expected a number, found"):
        asyncio.run(grasp_async(fake, given))
    assert fake.requests == []


LATE = {
    "ok": False,
    "error": "arm: the command was 0.40 s old when it was processed",
    "reason": "late",
}
MODE = {
    "ok": False,
    "error": "arm: not accepted in mode fault; clear the fault first",
    "reason": "mode",
}


def arm_blocking(fake: FakeDaemon, timeout: float) -> None:
    with Hand(fake.state_address, fake.command_address, timeout=timeout) as hand:
        hand.command("arm")


def arm_async(fake: FakeDaemon, timeout: float) -> None:
    async def arm() -> None:
        addresses = fake.state_address, fake.command_address
        async with AsyncHand(*addresses, timeout=timeout) as hand:
            await hand.command("arm")

    asyncio.run(arm())


@pytest.mark.parametrize("arm", [arm_blocking, arm_async])
def test_a_late_command_is_repeated_with_its_key_and_a_refused_one_is_not(fake, arm, monkeypatch):
    fake.replies["arm"] = [LATE, LATE, {"ok": True}, MODE]
    arm(fake, 60.0)
    assert len(fake.requests) == 3
    assert len(set(fake.keys)) == 1
    with pytest.raises(Refused, match="clear the fault first") as caught:
        arm(fake, 60.0)
    assert caught.value.reason == "mode"
    assert len(fake.requests) == 4
    assert len(set(fake.keys)) == 2
    # The delay before a second attempt exceeds the timeout.
    monkeypatch.setattr(command_client, "RETRY_DELAY", 100.0)
    fake.replies["arm"] = LATE
    with pytest.raises(Refused, match="old when it was processed") as caught:
        arm(fake, 60.0)
    assert caught.value.reason == "late"
    assert len(fake.requests) == 5


def test_a_cancelled_command_is_not_repeated(fake):
    async def cancelled() -> None:
        async with AsyncHand(fake.state_address, fake.command_address, timeout=60.0) as hand:
            arming = asyncio.create_task(hand.command("arm"))
            await asyncio.to_thread(until, lambda: len(fake.requests) >= 3)
            arming.cancel()
            with pytest.raises(asyncio.CancelledError):
                await arming

    fake.replies["arm"] = LATE
    asyncio.run(cancelled())  # The call returns after the current attempt.
    count, published = len(fake.requests), fake.published
    until(lambda: fake.published > published + 50)  # Wait for half a second.
    assert len(fake.requests) == count


def test_state_returns_a_current_state(fake, hand):
    hand.state()
    before = fake.published
    until(lambda: fake.published > before + 100)  # These states are queued.
    assert hand.state().seq >= 5 * (before + 50)


def test_gaps_are_counted_with_the_step_of_the_topic():
    gaps = Gaps()
    for seq in (5, 10, 16, 30, 36):  # The publisher sends every fifth state.
        gaps.take({"seq": seq, "seq_step": 5})
    assert gaps.lost == 2
    gaps.take({"seq": 5, "seq_step": 5})  # The daemon restarted without losses.
    gaps.take({"seq": 10, "seq_step": 5})
    assert gaps.lost == 2
    for finger in ("left", "right"):  # Lost frames are counted per finger.
        for seq in (1, 2, 4):
            gaps.take({"seq": seq, "finger": finger})
    assert gaps.lost == 4
    for seq, number in ((10, 1), (15, 2), (16, 4)):  # Frames are numbered separately.
        gaps.take({"seq": seq, "seq_step": 1, "number": number, "finger": "middle"})
    assert gaps.lost == 5
    again = Gaps()
    assert again.take({"seq": 5, "again": False})
    assert [again.take({"seq": seq, "again": True}) for seq in (3, 4, 5)] == [True, True, False]
    assert again.take({"seq": 8, "again": False})
    assert again.lost == 2
    assert again.take({"seq": 7, "again": True})  # The repeated message fills a gap.
    assert again.lost == 1
    assert again.take({"seq": 1, "again": False})  # The message comes from another daemon.
    assert again.take({"seq": 5, "again": False})
    assert not again.take({"seq": 5, "again": True})


def test_the_first_messages_of_a_restarted_daemon_are_not_repetitions():
    gaps = Gaps()
    for t in (10, 20):  # time at which each daemon sends its first message
        for seq in (1, 2):
            message = {"seq": seq, "again": True, "mono_ns": t + seq}
            assert gaps.take(message)
            assert not gaps.take(message)
    assert gaps.lost == 0
    for _ in range(2):  # Comparing nested lists would raise RecursionError.
        nested = msgpack.unpackb(1000 * b"\x91" + b"\x00")
        gaps.take({"seq": 2, "again": True, "mono_ns": nested})


def test_an_unknown_schema_is_reported_once_and_known_fields_are_kept(fake, hand):
    fake.changes = {"schema": 7, "news": [1, 2], "overruns": "many"}
    until(lambda: fake.published > 2)
    with hand.stream(timeout=60.0) as states:
        with pytest.warns(UserWarning, match="schema 7, but this client supports schema 1") as told:
            state = [next(states), next(states)][-1]
        assert len(told) == 1
        assert (state.schema, state.mode, state.overruns) == (7, "holding", 0)


def test_unreadable_messages_are_counted_and_skipped(fake, hand):
    with hand.stream(timeout=60.0) as states:
        next(states)
        for payload in (b"\xc1", b"", msgpack.packb([1]), b"\x91" * 5000):
            fake.send(b"hand/state", payload)
        until(lambda: next(states) and states.unreadable == 4)


@pytest.mark.parametrize(
    "changes",
    [{"rows": 43}, {"rows": -44, "cols": -44}, {"rows": True}, {"data": "text"}, {"cols": None}],
)
def test_a_frame_that_contradicts_its_header_is_rejected(changes):
    message = {**fake_daemon.frame(0.0, 0), **changes}
    with pytest.raises(ValueError, match="hand/tactile"):
        read(TactileFrame, message)


def test_a_frame_has_cell_positions_and_units():
    told = {"pitch_y": 0.002, "centre_x": 1e-4, "unit": "Pa", "scale": 0.5, "calibrated": True}
    message = {**fake_daemon.frame(0.0, 1), **told, "calibration": "A17 2026"}
    frame = read(TactileFrame, message)
    assert (frame.finger, frame.valid, frame.unit, frame.calibrated) == ("right", True, "Pa", True)
    where = frame.pitch_y, frame.centre_x, frame.centre_y
    assert (where, frame.calibration) == ((0.002, 1e-4, 0.0), "A17 2026")
    assert np.array_equal(frame.pressure, 0.5 * frame.counts)


def test_missing_fields_are_nan():
    state = read(HandState, {"left": {"force": "much"}, "object": 3})
    assert math.isnan(state.left.force)
    assert math.isnan(state.object.width)
    assert (state.mode, state.seq, state.torque) == ("", 0, False)
    assert read(Event, {}).text == ""
    with pytest.raises(ValueError, match="found finger 'thumb'"):
        state.finger("thumb")
    columns = to_columns([])
    assert columns["left.force"].shape == columns["object.angle"].shape == (0,)


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import softfinger; softfinger.Hand; softfinger.AsyncHand", {"pydantic"}),
        ("import softfinger.tools.terminal.monitor", {"pydantic", "asyncio"}),
        ("import softfinger.tools.terminal.send", {"pydantic", "asyncio", "numpy"}),
        ("import softfinger.daemon.gateway.server", {"pydantic", "numpy"}),
    ],
)
def test_clients_and_the_gateway_import_nothing_of_the_daemon(code, absent):
    done = python("-c", f"import sys; {code}; print(*sys.modules)")
    loaded = set(done.stdout.split())
    assert any(name.startswith("softfinger.daemon.") for name in loaded), done.stderr
    kernels = "softfinger.kinematics.compiled.kernel"
    assert not loaded & {"numba", kernels, "softfinger.daemon.loop", *absent}


def _face(cls: type) -> dict[str, object]:
    """Return the class's public methods with parameters and defaults."""
    found = {name: member for name, member in vars(cls).items() if not name.startswith("_")}
    return {
        name: list(inspect.signature(member).parameters.values()) if callable(member) else None
        for name, member in found.items()
    }


def test_synchronous_and_asyncio_hands_have_the_same_methods():
    untyped = [re.sub(r"Async", "", repr(_face(cls))) for cls in (Hand, AsyncHand)]
    assert untyped[0] == untyped[1]
    assert _face(Subscription) == _face(AsyncSubscription)
    commands = {"arm", "disarm", "clear", "grasp", "rotate", "release", "move", "stop", "tare"}
    for cls in (Hand, AsyncHand):
        assert commands | {"status", "collect", "state", "close"} <= set(dir(cls))


def test_commands_that_are_already_fulfilled_succeed(fake, hand):
    fake.replies = {
        name: {"ok": False, "error": f"{name}: not accepted in mode it is so"}
        for name in ("arm", "disarm", "clear")
    }
    fake.replies["status"] = {"ok": True, "mode": "holding", "torque": True}
    hand.arm()
    hand.clear()
    fake.replies["status"] = {"ok": True, "mode": "fault", "torque": False}
    hand.disarm()
    for status in ({"ok": True, "mode": "fault", "torque": True}, {"ok": False}, None):
        fake.replies["status"] = status
        for refused in (hand.arm, hand.disarm, hand.clear):
            with pytest.raises(Refused, match="not accepted in mode it is so"):
                refused()


def test_a_refused_motion_command_causes_no_other_request(fake, hand):
    fake.replies["rotate"] = MODE

    async def rotate() -> None:
        async with AsyncHand(fake.state_address, fake.command_address, timeout=60.0) as hand:
            await hand.rotate(0.1)

    for refused in (lambda: hand.rotate(0.1), lambda: asyncio.run(rotate())):
        with pytest.raises(Refused):
            refused()
    assert [request["command"] for request in fake.requests] == ["rotate", "rotate"]


@pytest.mark.parametrize("reply", [b"", b"\xc1", b"hello", b"\x91" * 5000, msgpack.packb([1])])
def test_an_unreadable_reply_is_reported_as_no_answer(fake, hand, reply):
    fake.replies["arm"] = reply
    with pytest.raises(NoAnswer, match=re.escape(f"{fake.command_address} sent an invalid reply")):
        hand.arm()


def test_unconfirmed_torque_off_causes_a_warning(fake, hand, caplog):
    hand.disarm()
    assert not caplog.messages
    fake.replies["disarm"] = {"ok": True, "torque_off": "unconfirmed"}
    hand.disarm()
    assert caplog.messages == [UNCONFIRMED_TEXT]


def test_a_closed_hand_raises_a_clear_error(hand):
    states = hand.stream()
    other = hand.stream()
    other.close()
    with pytest.raises(HandClosed, match="this subscription is closed"):
        next(other)
    hand.close()
    hand.close()
    for use in (hand.arm, hand.state, hand.stream, lambda: next(states)):
        with pytest.raises(HandClosed, match="is closed: create a new one"):
            use()

    async def after() -> None:
        async with AsyncHand(hand.stream_address, hand.command_address) as other:
            pass
        with pytest.raises(HandClosed, match="this AsyncHand is closed"):
            await other.arm()
        with pytest.raises(HandClosed, match="this AsyncHand is closed"):
            await other.state()

    asyncio.run(after())


@pytest.mark.parametrize(
    ("named", "addresses"),
    [
        ("", (STREAM_ADDRESS, COMMAND_ADDRESS)),
        ("tcp://10.0.0.7", ("tcp://10.0.0.7:9872", "tcp://10.0.0.7:9873")),
        ("tcp://[fe80::1]", ("tcp://[fe80::1]:9872", "tcp://[fe80::1]:9873")),
        ("ipc:///run/a, ipc:///run/b", ("ipc:///run/a", "ipc:///run/b")),
    ],
)
@pytest.mark.parametrize("given", [False, True], ids=["environment", "argument"])
def test_one_string_names_both_addresses(monkeypatch, named, addresses, given):
    monkeypatch.setenv("SOFTFINGER_ADDRESS", "" if given else named)
    with Hand(named if given else None) as hand:
        assert (hand.stream_address, hand.command_address) == addresses
    for wrong in ("10.0.0.7", "tcp://10.0.0.7:9872", "ipc:///run/a", "a,b,c"):
        monkeypatch.setenv("SOFTFINGER_ADDRESS", wrong)
        with pytest.raises(SettingsError, match=r"SOFTFINGER_ADDRESS: found .*, expected tcp://H"):
            Hand()
        with Hand(*addresses) as hand:  # The environment variable is not read.
            assert (hand.stream_address, hand.command_address) == addresses


UNKNOWN = "unknown host 'no..host' (not a host name); expected an IP address or a"


@pytest.mark.parametrize("cls", [Hand, AsyncHand])
@pytest.mark.parametrize(
    "given",
    [
        {"stream": "tcp://no..host"},
        {"stream": "tcp://no..host:9872", "commands": COMMAND_ADDRESS},
        {"stream": STREAM_ADDRESS, "commands": "tcp://no..host:9873"},
    ],
)
def test_an_unknown_host_fails_at_once_with_its_name(cls, given):
    with pytest.raises(SettingsError, match=re.escape(UNKNOWN)):
        cls(**given)


@pytest.mark.parametrize("cls", [Hand, AsyncHand])
@pytest.mark.parametrize(
    "address",
    ["foo", "http://127.0.0.1:9872", "ipc://", "ipc:///" + "a" * 107, "tcp://127.0.0.1"]
    + [f"tcp://127.0.0.1:{port}" for port in ("", "abc", "0", "65536", "99999999", "9872/x")],
)
def test_a_malformed_address_fails_at_once(cls, inline, address):
    for given in ((address, COMMAND_ADDRESS), (STREAM_ADDRESS, address)):
        with pytest.raises(SettingsError, match=f"{re.escape(address)}: malformed address; expe"):
            cls(*given)
    if cls is Hand and address != "tcp://127.0.0.1":
        done = inline("status", "--address", address)
        assert (done.returncode, "malformed address" in done.stderr) == (2, True)


@pytest.mark.parametrize("given", [{"stream": "tcp://[::1]:9872"}, {"commands": "tcp://[::1]:9"}])
def test_one_address_alone_is_an_error_instead_of_another_hand(given):
    with pytest.raises(SettingsError, match="expected tcp://HOST or STREAM,COMMANDS"):
        Hand(**given)


def test_a_host_that_the_resolver_does_not_know_is_named_with_its_reason(monkeypatch):
    def unknown(host: str, _: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, f"no address for {host}")

    monkeypatch.setattr(connection, "getaddrinfo", unknown)
    with pytest.raises(SettingsError, match=r"unknown host 'lab7' \(no address for lab7\)"):
        Hand("tcp://lab7")
    with Hand("ipc:///run/a,ipc:///run/b"):
        pass  # An IPC address has no host.
    monkeypatch.undo()
    with Hand("tcp://127.0.0.1:0;127.0.0.1:9872", "tcp://[::1]:9873"):
        pass  # The first address includes a source address, and the second address is numeric.


@pytest.mark.parametrize("words", [["monitor"], ["send", "stop"], ["status"], ["record", "a.mcap"]])
@pytest.mark.parametrize("given", [True, False], ids=["argument", "environment"])
def test_commands_fail_at_once_for_an_unknown_host(inline, monkeypatch, words, given):
    monkeypatch.setenv("SOFTFINGER_ADDRESS", "" if given else "tcp://no..host")
    done = inline(*words, *(["--address", "tcp://no..host"] if given else []))
    assert done.returncode == 2
    assert UNKNOWN in done.stderr


def in_a_thread(use: Callable[[], object]) -> BaseException | None:
    """Return the exception that a call raises in a separate thread."""
    with ThreadPoolExecutor(1, "other") as pool:
        return pool.submit(use).exception(60.0)


def test_a_second_thread_that_uses_the_stream_is_refused_at_once(fake, hand):
    states = hand.stream(60.0)
    assert in_a_thread(hand.grasp) is None  # Commands have their own socket.
    next(states)
    for use in (
        lambda: next(states),
        hand.state,
        lambda: next(hand.events()),
        lambda: hand.wait_for(lambda _: True),
        states.skip,
        states.close,
        hand.close,
    ):
        error = in_a_thread(use)
        assert isinstance(error, WrongThread), use
        assert "thread other_0: thread MainThread already uses the stream of this Hand" in str(
            error
        )
    assert next(states).mode == hand.state().mode == "holding"


def test_a_hand_may_be_used_after_the_thread_that_used_it(fake, hand):
    assert in_a_thread(hand.state) is None
    assert hand.state().mode == "holding"


def test_a_thread_that_waits_without_limit_is_not_disturbed(fake, hand):
    fake.changes = {"mode": "armed"}
    found: list[str] = []
    waits = threading.Event()

    def wait() -> None:
        ended = hand.wait_for(lambda state: waits.set() or state.mode == "holding", 60.0)
        found.append(ended.mode)

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert waits.wait(60.0)
    for use in (hand.state, hand.close):
        with pytest.raises(WrongThread):
            use()
    fake.changes = {"mode": "holding"}
    waiting.join(60.0)
    assert found == ["holding"]


def test_two_threads_do_not_share_an_async_hand(fake):
    async def state(hand: AsyncHand) -> str:
        return (await hand.state(60.0)).mode

    async def session() -> None:
        async with AsyncHand(fake.state_address, fake.command_address, timeout=60.0) as hand:
            await hand.state()
            error = await asyncio.to_thread(in_a_thread, lambda: asyncio.run(state(hand)))
            assert isinstance(error, WrongThread)

    asyncio.run(session())


def test_status_prints_one_line_or_the_complete_state_as_json(fake, inline):
    left, right = fake_daemon.finger(0.0, 0), fake_daemon.finger(0.0, 1)
    fake.changes = {"left": left, "right": right, "goal_force": math.nan}
    before = fake.published
    until(lambda: fake.published > before + 1)  # From now on, all states include the changes.
    told = inline("status", "--address", fake.state_address)
    assert told.returncode == 0
    line = re.fullmatch(r"(\w+) (\S+) N \(\S+ ± \S+, \S+ ± \S+\), (\S+)°, (\S+) mm\n", told.stdout)
    assert line is not None, told.stdout
    assert line[1] == "holding"
    assert float(line[2]) == pytest.approx(0.5 * (left["force"] + right["force"]), abs=0.06)
    assert float(line[3]) == pytest.approx(4.98, abs=0.06)
    assert float(line[4]) == pytest.approx(40.0, abs=0.06)
    whole = json.loads(inline("status", "--json", "--address", fake.state_address).stdout)
    assert (whole["left"]["force"], whole["goal_force"]) == (left["force"], None)
    fake.changes = {"mode": "fault", "fault": "servo 1: overload"}
    failed = inline("status", "--address", fake.state_address)
    assert (failed.returncode, failed.stdout) == (1, "fault: servo 1: overload\n")


def test_a_stop_does_not_wait_for_the_pending_commands_of_an_asyncio_program(fake):
    """The default thread pool of asyncio has at most 36 threads."""
    over = threading.Event()

    async def stop() -> None:
        async with AsyncHand(fake.state_address, fake.command_address, timeout=60.0) as hand:
            pending = [asyncio.create_task(asyncio.to_thread(over.wait)) for _ in range(40)]
            try:
                await asyncio.wait_for(hand.stop(), 120.0)
            finally:
                over.set()
            await asyncio.gather(*pending)

    asyncio.run(stop())


@pytest.mark.skipif(not socket.has_ipv6, reason="needs IPv6")
def test_commands_reach_an_ipv6_address():
    with zmq.Context() as context, context.socket(zmq.REP) as server:
        server.setsockopt(zmq.IPV6, 1)
        port = server.bind_to_random_port("tcp://[::1]")

        def reply() -> None:
            server.recv()
            server.send(msgpack.packb({"ok": True}))

        thread = threading.Thread(target=reply)
        thread.start()
        assert command_client.send(f"tcp://[::1]:{port}", {"command": "status"}, 60.0)["ok"]
        thread.join()
