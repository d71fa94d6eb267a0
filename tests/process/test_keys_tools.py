"""Test that every client tool supports keys and reports missing keys."""

import asyncio
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from softfinger import AsyncHand, Hand, NoStream
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import make_keys
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.replay import Wire
from tests.conftest import Addresses, own_addresses, until, write_profile
from tests.harness.daemon_process import (
    Running,
    ask,
    started,
    until_it_says,
)
from tests.harness.viewed import Viewed, Watcher
from tests.process.test_record import interrupted, is_filled, record, written
from tests.unit.test_schema import sample


class Guarded(NamedTuple):
    """A daemon that accepts only clients whose keys are in ``folder``."""

    folder: Path
    addresses: Addresses
    recording: Path  # recording made by the daemon


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    place = tmp_path_factory.mktemp("guarded")
    make_keys(place / "keys", ["alice"])
    addresses, own = own_addresses(), place / "own.mcap"
    text = f'access.keys = "{place / "keys"}"\nloop.rate = 50.0\nservos.watchdog = 0.0\n'
    path = write_profile(place / "profile.toml", addresses, text)
    daemon = Running("--config", str(path), "--record", str(own))
    yield Guarded(place / "keys", addresses, own)
    try:
        assert daemon.end() == 0
    finally:
        daemon.kill()


def test_tools_with_keys_see_and_command_the_hand(guarded, tmp_path, inline):
    folder, addresses, _ = guarded
    stream, commands = addresses
    alice = ("--keys", str(folder / "alice"))
    path = tmp_path / "a.mcap"
    recorder = record(path, "--address", stream, *alice)
    until(lambda: is_filled(path))
    assert interrupted(recorder)[0] == 0
    assert Recording(path).counts["hand/state"] > 0
    with Viewed("--address", stream, *alice) as viewed, Watcher(viewed.host) as page:
        until(lambda: page.next()["mode"] == "disarmed")
        viewed.end()
    with Hand(*addresses, keys=folder / "alice", timeout=60.0) as hand:
        hand.arm()
        assert hand.wait_for(lambda state: state.torque, 60.0).mode == "armed"
        told = inline("send", "status", "--address", commands, *alice, "--timeout", "60")
        assert json.loads(told.stdout)["torque"] is True
    where = ("--address", f"{stream},{commands}")
    until_it_says(("monitor", "--plain", *where, *alice), " armed")

    async def session() -> str:
        async with AsyncHand(*addresses, keys=folder / "alice", timeout=60.0) as hand:
            await hand.command("disarm")
            return (await hand.wait_for(lambda state: not state.torque, 60.0)).mode

    assert asyncio.run(session()) == "disarmed"
    # Any user who may kill the daemon process may also stop the hand, even without a key.
    assert ask(commands, "stop")["ok"]


@pytest.mark.extended
def test_tools_without_keys_receive_nothing_and_suggest_the_option(guarded, tmp_path, inline):
    stream, commands = guarded.addresses
    path = tmp_path / "b.mcap"
    tools = [
        started(*words)
        for words in (
            ("record", str(path), "--address", stream, "--no-wait"),
            ("view", "--no-browser", "--port", "0", "--address", stream, "--no-wait"),
            ("monitor", "--plain", "--address", f"{stream},{commands}", "--no-wait"),
            ("send", "status", "--address", commands, "--timeout", "0.5"),
        )
    ]
    for tool in tools:
        said = tool.communicate(timeout=300)[1]
        assert tool.returncode in (1, 2), tool.args
        assert "--keys" in said, tool.args
    # If keys are missing, the tool reports this and does not create the recording.
    path = tmp_path / "c.mcap"
    done = inline("record", path, "--address", stream, "--keys", tmp_path / "none")
    assert done.returncode == 1
    assert "softfinger keys" in done.stderr
    assert not path.exists()


def test_a_daemon_with_keys_records_itself(guarded):
    def first_input() -> dict[str, Any] | None:
        inputs = Recording(guarded.recording).messages([b"hand/input"])
        return next((message for _, message in inputs), None)

    until(lambda: guarded.recording.stat().st_size > 3000)
    until(first_input)  # The file may start with messages of other topics.
    assert first_input()["seq"] == 1


def test_a_replay_is_sent_only_to_holders_of_keys(addresses, tmp_path):
    path, folder = tmp_path / "run.mcap", tmp_path / "keys"
    make_keys(folder, ["alice"])
    written(path, 20)
    replay = started("replay", path, "--address", addresses[0], "--keys", folder)
    try:
        with (
            Hand(*addresses, keys=folder / "alice", timeout=60.0) as hand,
            Hand(*addresses, timeout=60.0) as stranger,
        ):
            assert hand.stream(60.0).next(60.0).mode == sample(schema.STATE)["mode"]
            with pytest.raises(NoStream):
                stranger.state(0.3)
    finally:
        replay.terminate()
        out, error = replay.communicate(timeout=300)
    assert replay.returncode == 0, error
    assert re.search(r"\d+ of \d+ messages published", out)
    assert "waiting up to 10 s for a subscriber" in error


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("tcp://0.0.0.0:9999", "other addresses require --keys"),
        ("tcp://*:9999", "other addresses require --keys"),
        ("nonsense", "expected tcp://127.0.0.1:PORT"),
    ],
)
def test_a_replay_without_keys_stays_on_this_machine(address, reason):
    with pytest.raises(RecordingError, match=reason):
        Wire(address)


def test_late_subscribers_of_a_replay_receive_earlier_settings_and_events(addresses):
    told = {"schema": 1, "seq": 1, "again": False, "timestamp": 1.0, "mono_ns": 5, "settings": "{}"}
    event = {"schema": 1, "seq": 7, "again": False, "timestamp": 2.0, "text": "b"}
    with Wire(addresses[0]) as wire, Hand(*addresses, timeout=60.0) as hand:
        with hand.events() as early:
            until(lambda: wire.subscribed(0.01))
            wire.send(b"hand/settings", told)
            wire.send(b"hand/event", event)
            assert not early.next(60.0).again
        with hand.events() as late:
            again = late.next(60.0)
    assert (again.seq, again.again, again.text) == (7, True, "b")
