"""IDs and rates: who is who on a bus, servos that answer at once, and setting them one by one."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger.daemon.diagnosis import hand
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import mend as mending
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.identity import plan
from softfinger.daemon.servos.mend import mend
from softfinger.daemon.servos.models import by_name
from softfinger.daemon.servos.scanning import Found, FoundServo, Garbled, search
from softfinger.daemon.simulation.emulator.emulator import Emulator
from softfinger.daemon.simulation.servo_model import protocol
from softfinger.daemon.simulation.servo_model.collision import collide, overlay
from softfinger.daemon.simulation.servo_model.protocol import BROADCAST, frame
from softfinger.tools import doctor
from softfinger.tools.cli import main
from tests.harness.servos import make_bus

MODEL = by_name("XM430-W350")
RATES = MODEL.baud_rates
HOME = 2_000_000


def servo(servo_id: int, baud: int = HOME, number: int = MODEL.number) -> FoundServo:
    return FoundServo(servo_id, baud, number, 48)


def planned(*servos: FoundServo, garbled: tuple[Garbled, ...] = (), **settings: Any) -> list[str]:
    """The changes, the fingers still missing and the strangers, as text."""
    found = Found(servos, garbled)
    what = plan(found, Settings.model_validate(settings), MODEL, RATES)
    changes = [f"{each.finger}: {each}" for each in what.changes]
    missing = [f"missing {finger}" for finger in what.missing]
    return changes + missing + [f"stranger {each.id}@{each.baud}" for each in what.strangers]


# --- who is who --------------------------------------------------------------------------------


def test_servos_at_home_need_nothing() -> None:
    assert planned(servo(1), servo(2)) == []
    assert planned(servo(1), servo(2), servo(9)) == ["stranger 9@2000000"]


def test_the_right_id_at_another_rate_is_that_servo() -> None:
    assert planned(servo(1, 57600), servo(2, 57600)) == [
        "0: 57600 → 2000000 baud",
        "1: 57600 → 2000000 baud",
    ]


def test_a_single_servo_is_the_single_missing_one() -> None:
    assert planned(servo(1), servo(1, 57600)) == ["1: ID 1 → 2, 57600 → 2000000 baud"]
    assert planned(servo(1), servo(7)) == ["1: ID 7 → 2"]
    only_left = {"scene": {"fingers": ("left",)}, "servos": {"ids": (11, 12)}}
    assert planned(servo(1, 57600), **only_left) == ["0: ID 1 → 11, 57600 → 2000000 baud"]


def test_the_servo_of_a_finger_that_the_scene_leaves_out_is_not_the_missing_one() -> None:
    only_left = {"scene": {"fingers": ("left",)}}
    assert planned(servo(2), **only_left) == ["missing 0", "stranger 2@2000000"]
    only_right = {"scene": {"fingers": ("right",)}}
    assert planned(servo(1), **only_right) == ["missing 1", "stranger 1@2000000"]
    # From the factory, at another rate, it is nobody's.
    assert planned(servo(1, 57600), **only_right) == ["1: ID 1 → 2, 57600 → 2000000 baud"]


@pytest.mark.parametrize(
    ("found", "told"),
    [
        ((servo(7),), ["missing 0", "missing 1", "stranger 7@2000000"]),
        ((servo(1), servo(7), servo(8)), ["missing 1", "stranger 7@2000000", "stranger 8@2000000"]),
        ((servo(1), servo(7, number=1200)), ["missing 1", "stranger 7@2000000"]),
        # The same ID at two rates, none of them the settings': which one?
        (
            (servo(1, 57600), servo(1, 1_000_000), servo(2)),
            ["missing 0", "stranger 1@57600", "stranger 1@1000000"],
        ),
    ],
)
def test_what_would_be_a_guess_is_left_alone(found: tuple[FoundServo, ...], told: list) -> None:
    assert planned(*found) == told


def test_what_is_garbled_is_left_alone() -> None:
    bad = (Garbled(1, 57600),)
    assert planned(servo(1, 57600), garbled=bad) == ["missing 0", "missing 1"]
    # Nor may a servo join an ID that is garbled.
    assert planned(servo(2), servo(9, 57600), garbled=(Garbled(1, HOME),)) == [
        "missing 0",
        "stranger 9@57600",
    ]


def test_a_stand_in_that_answers_at_every_rate_is_one_servo() -> None:
    everywhere = [servo(servo_id, rate) for servo_id in (1, 2) for rate in RATES]
    assert planned(*everywhere) == []


# --- servos that answer at once -----------------------------------------------------------------


def test_a_low_bit_wins() -> None:
    assert overlay([(0, b"\x0f\xff"), (0, b"\x3c\xf0")]) == b"\x0c\xf0"
    assert overlay([(0, b"\x55")]) == b"\x55"
    assert overlay([(3, b"abc"), (3, b"abc")]) == b"abc"
    alone = bytes(range(256))
    assert overlay([(0, alone)]) == alone


def test_shifted_bits_are_garbled() -> None:
    reply = protocol.status(1, 0, b"\xfc\x03\x30")
    whole = [overlay([(0, reply), (shift, reply)]) == reply for shift in range(10)]
    assert whole == [True] + [False] * 9
    # At a slow rate a bit is longer than the servos' jitter.
    source = random.Random(3)
    assert any(collide([reply, reply], 9600, source) == reply for _ in range(5))
    assert not any(collide([reply, reply], 4_000_000, source) == reply for _ in range(5))


def test_servos_that_share_an_id_answer_at_once() -> None:
    bus = make_bus(ids=(1, 1, 2), counts=(100, 200, 300))
    read = frame(1, protocol.READ, b"\x84\x00\x04\x00")
    replies = [bus.feed(read, 0.0) for _ in range(8)]
    sound = [protocol.status(1, 0, (100 * k).to_bytes(4, "little")) for k in (1, 2)]
    assert not any(reply in sound for reply in replies)
    assert len(bus.feed(frame(2, protocol.PING), 0.0)) == 14
    assert bus.feed(frame(BROADCAST, protocol.PING), 0.0)[-14:-9] == b"\xff\xff\xfd\x00\x02"
    group = frame(BROADCAST, protocol.SYNC_READ, b"\x84\x00\x04\x00\x02\x01")
    assert bus.feed(group, 0.0)[:5] == b"\xff\xff\xfd\x00\x02"


# --- through the whole path ---------------------------------------------------------------------


class Bus:
    """Factory-new servos, ID 1 at 57600 baud, behind an emulator; ``silent`` ones are unplugged."""

    def __init__(self, folder: Path, *faults: str, **options: Any) -> None:
        self.folder = folder
        self.config = folder / "hand.toml"
        self.config.write_text(
            'tactile.backend = "none"\n[servos]\nbackend = "dynamixel"\nport = "{dir}/servos"\n'
        )
        self.settings = load(self.config, folder)
        self.emulator = Emulator(self.settings, folder, faults=faults, **options)
        ready = threading.Event()
        self._thread = threading.Thread(target=self.emulator.run, args=(ready.set,), daemon=True)
        self._thread.start()
        assert ready.wait(200)

    @property
    def servos(self) -> list[Any]:
        return self.emulator._servos.bus.servos

    def addresses(self) -> list[tuple[int, int]]:
        return [(each.id, each.baud) for each in self.servos]

    def connect(self, index: int) -> None:
        self.servos[index].silent = False

    def disconnect(self, index: int) -> None:
        self.servos[index].silent = True

    def close(self) -> None:
        self.emulator.stop()
        self._thread.join()
        self.emulator.close()


@pytest.fixture
def factory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bus]]:
    monkeypatch.setattr(mending, "_SEARCH", 0.05)
    made: list[Bus] = []

    def start(*faults: str, **options: Any) -> Bus:
        values = {"baud": 57600, "prepared": False, "ids": (1, 1)} | options
        made.append(Bus(tmp_path, *faults, **values))
        return made[-1]

    yield start
    for each in made:
        each.close()


def test_two_factory_servos_are_set_up_one_after_the_other(factory: Callable[..., Bus]) -> None:
    bus = factory()
    bus.disconnect(1)
    with pytest.raises(ServoError) as caught:
        mend(bus.settings)
    assert str(caught.value).splitlines() == [
        "servo 2 (right): no answer at any rate: check its power and cable",
        "(done: servo 1 (left): 57600 → 2000000 baud)",
        "(done: servo 1 (left): operating mode 3 → 5)",
        "(done: servo 1 (left): return delay 250 → 0)",
    ]
    assert bus.addresses() == [(1, HOME), (1, 57600)]
    bus.connect(1)
    assert mend(bus.settings) == [
        "servo 2 (right): ID 1 → 2, 57600 → 2000000 baud",
        "servo 2 (right): operating mode 3 → 5",
        "servo 2 (right): return delay 250 → 0",
    ]
    assert bus.addresses() == [(1, HOME), (2, HOME)]
    assert mend(bus.settings) == []
    assert not any(each.torque_on for each in bus.servos)


def test_factory_servos_together_are_told_and_not_touched(factory: Callable[..., Bus]) -> None:
    bus = factory()
    before = [bytes(each.table.memory[: reg.RAM]) for each in bus.servos]
    found = search(str(bus.folder / "servos"), (57600, HOME), 0.05)
    assert found.garbled == (Garbled(1, 57600),)
    with pytest.raises(ServoError, match="several servos have that ID, as all have from the fac"):
        mend(bus.settings)
    assert [bytes(each.table.memory[: reg.RAM]) for each in bus.servos] == before


def test_the_commands_tell_what_they_found_and_change_nothing_unasked(
    factory: Callable[..., Bus],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bus = factory(ids=(1, 7), baud=HOME, prepared=True)
    whole = hand.check_servos
    monkeypatch.setattr(doctor, "check_servos", lambda settings: whole(settings, 0.1, 0.05))
    for check in ("check_addresses", "check_machine", "check_kernels"):
        monkeypatch.setattr(doctor, check, lambda *_: [])
    words = ["doctor", "--config", str(bus.config), "--dir", str(bus.folder)]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "note   found: ID 7 at 2000000 baud: XM430-W350, firmware 48" in out
    assert "doctor --fix makes it servo 2 (right): ID 7 → 2; or set servos.ids as it is" in out
    assert bus.addresses() == [(1, HOME), (7, HOME)]
    assert main([*words, "--fix"]) == 0
    assert "fixed  servo 2 (right): ID 7 → 2" in capsys.readouterr().out
    assert bus.addresses() == [(1, HOME), (2, HOME)]
    bus.servos[1].table.set(reg.ID, 1)
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "FAIL   servos: replies of ID 1 at 2000000 baud come damaged: several servos" in out
    assert "→ connect one servo alone, then `softfinger doctor --fix`" in out
    main(["scan", str(bus.folder / "servos"), "--baud", str(HOME), "--wait", "0.05"])
    assert "replies of ID 1 at 2000000 baud come damaged" in capsys.readouterr().out


@pytest.mark.parametrize("spoil", ["torque", "mute"])
def test_a_servo_that_holds_or_is_mute_is_set_too(factory: Callable[..., Bus], spoil: str) -> None:
    bus = factory(ids=(1, 7), baud=HOME, prepared=True)
    stray = bus.servos[1].table
    if spoil == "torque":
        stray.set(reg.TORQUE_ENABLE, 1)
    else:
        stray.set(reg.STATUS_RETURN_LEVEL, 0)
    done = mend(bus.settings)
    assert "servo 2 (right): ID 7 → 2" in done
    assert (spoil == "torque") == any("torque off" in line for line in done)
    assert not bus.servos[1].torque_on
    assert stray.get(reg.STATUS_RETURN_LEVEL) == 2
