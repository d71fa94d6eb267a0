"""Fuzz commands, profiles and calibration files: invalid input must be rejected cleanly.

Commands are sent to a running hand. Every hundredth command is sent through a real socket.
"""

import json
import random
import struct
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import msgpack
import zmq

from softfinger.daemon.control.modes import COMMANDS
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.perception.calibration_file import CalibrationFileError, load_calibration
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.loop_link import machine_time
from tests.fuzz import mutated
from tests.harness.gateway import Served

ROOT = Path(__file__).parents[2]
_MAX_BYTES = 4096

_ODD = (
    *(None, True, False, 0, -1, 1, 2**63, -(2**63), 0.0, -0.0, 1e308, -1e308, 5e-324),
    *(float("nan"), float("inf"), float("-inf"), "", "stop", "x" * 5000, "\0", "é\u202e", b"\xff"),
    *([], {}, [[]], {"command": "stop"}, msgpack.Timestamp(1), msgpack.ExtType(5, b"x")),
)


# --- commands ---------------------------------------------------------------------------------


def some_request(rng: random.Random) -> Any:
    """Return a valid or slightly malformed command."""
    name = rng.choice([*COMMANDS, "arm", "grasp", "nothing"])
    request: dict[Any, Any] = {"command": name}
    for key in COMMANDS[name].parameters if name in COMMANDS else ():
        if rng.random() < 0.8:
            request[key] = rng.choice((rng.uniform(-2, 12), rng.choice(_ODD)))
    if rng.random() < 0.3:
        request["client"] = rng.choice(("", "me", "you", rng.choice(_ODD)))
    if rng.random() < 0.3:
        request["key"] = rng.choice(("a", f"{rng.random()}", rng.choice(_ODD)))
    if rng.random() < 0.2:
        request[rng.choice(("force", "left", "junk", 3, b"x"))] = rng.choice(_ODD)
    return request if rng.random() < 0.97 else rng.choice((request["command"], [request], None))


def some_message(rng: random.Random) -> bytes:
    """Return bytes for the command socket."""
    kind = rng.random()
    if kind < 0.1:
        return rng.randbytes(rng.randrange(0, 200))
    if kind < 0.12:
        return rng.randbytes(rng.choice((_MAX_BYTES - 1, _MAX_BYTES + 1, 4 * _MAX_BYTES + 1)))
    if kind < 0.15:  # Return a deeply nested or truncated value.
        deep = rng.choice((b"\x91" * 3000, b"\x81\xa1a" * 1000, b"\xdf\xff\xff\xff\xff"))
        return deep + rng.randbytes(rng.randrange(8))
    try:
        packed = msgpack.packb(some_request(rng))
    except (OverflowError, ValueError):
        packed = struct.pack(">Bq", 0xD3, -5)
    return packed if kind < 0.35 else mutated(rng, packed)


class CommandTarget:
    """Hand in virtual time; messages are passed to the hand directly or through a socket.

    After every message, the loop must still run and the goals must be within the limits. In the
    disarmed and fault modes, torque must be off.
    """

    def __init__(self) -> None:
        settings = Settings.model_validate({"loop": {"clock": "virtual"}})
        self.daemon = Daemon(settings, wire=False)
        self.loop = self.daemon.loop
        self.loop.advance(0.3)
        self.folder = TemporaryDirectory()
        address = f"ipc://{self.folder.name}/commands"
        self.served = Served(commands=address, max_bytes=_MAX_BYTES)
        self.context: zmq.Context[Any] = zmq.Context()
        self.client = self.context.socket(zmq.DEALER)
        self.client.connect(address)
        self.asked = 0

    def give(self, rng: random.Random) -> tuple[str, bytes]:
        """Send one message; return the kind of result and the message."""
        self.asked += 1
        message = some_message(rng)
        by_socket = self.asked % 100 == 0 and len(message) <= 4 * _MAX_BYTES
        reply = self._by_socket(message) if by_socket else self._directly(message)
        told = "done" if reply["ok"] else "refused"
        if not reply["ok"]:
            assert isinstance(reply["error"], str), reply
            assert len(reply["error"]) < 500, reply
        if self.asked % 20 == 0:
            self.loop.advance(self.loop.period)
            self._check()
        return told, message

    def _by_socket(self, message: bytes) -> dict[str, Any]:
        self.client.send_multipart([b"", message])
        for _ in range(10_000):
            self.served.serve(self.loop.command)
            if self.client.poll(0):
                return msgpack.unpackb(self.client.recv_multipart()[-1])
        raise AssertionError("no reply")

    def _directly(self, message: bytes) -> dict[str, Any]:
        commands, sent = self.served.service.commands, []
        with patch.object(commands, "_send", sent.append):
            commands._take([b"%d" % self.asked, message], "", machine_time())
            for _ in range(3):
                self.served.serve(self.loop.command)
                sent.extend(commands._replies)  # replies that the gateway delays after a stop
                commands._replies.clear()
                if sent:
                    break
        (reply,) = sent
        return msgpack.unpackb(reply[-1])

    def _check(self) -> None:
        state, hand = self.loop.state, self.daemon.settings.hand
        if state.mode == "fault":
            self.loop.advance(0.1)
        if state.mode in ("disarmed", "fault"):
            assert not state.torque, state.mode
        elif state.goal.valid:
            for i in range(2):
                assert hand.q_min[i] <= state.goal.q[i] <= hand.q_max[i], state.goal
                assert 0.0 <= state.goal.current[i] <= self.daemon.settings.safety.current_max

    def close(self) -> None:
        self.client.close(linger=0)
        self.served.close()
        self.context.destroy(linger=0)
        self.folder.cleanup()
        self.daemon.close()


# --- files ------------------------------------------------------------------------------------


class FileTarget:
    """File reader under test; it must return the content or raise the documented exception."""

    def __init__(
        self, read: Callable[[Path], Any], error: type[Exception], seeds: list[bytes], end: str
    ) -> None:
        self._read = read
        self._error = error
        self._seeds = seeds
        self._folder = TemporaryDirectory()
        self._path = Path(self._folder.name) / f"fuzz{end}"

    def give(self, rng: random.Random) -> tuple[str, bytes]:
        """Read one file; return the kind of result and the file's content."""
        kind = rng.random()
        text = rng.choice(self._seeds)
        if kind < 0.05:
            text = rng.randbytes(rng.randrange(0, 400))
        elif kind < 0.5:
            text = mutated(rng, text)
        elif kind < 0.98:
            text = _tokens_mixed(rng, text)
        else:
            text = rng.choice((b"[", b"{", b"a=[", b'{"a":')) * rng.choice((50, 3000))
        self._path.write_bytes(text)
        try:
            self._read(self._path)
        except self._error as error:
            if not str(error):
                raise AssertionError(f"{type(error).__name__} without a message") from error
            return "refused", text
        return "done", text

    def close(self) -> None:
        self._folder.cleanup()


_VALUES = (
    *(b"0", b"-1", b"1e308", b"-1e-308", b"nan", b"inf", b"1e999", b"true", b'""', b'"none"'),
    *(b"[]", b"{}", b"[1, 2]", b'["left"]', b"9" * 400, b'"' + b"x" * 3000 + b'"', b"null"),
    *(b"1979-05-27", b"0x7fffffffffffffff", b"[[1.0, 2.0]]", b'"\\u0000"', b"\xff\xfe"),
)


def _tokens_mixed(rng: random.Random, text: bytes) -> bytes:
    """Replace values in a text file, and drop, repeat or move lines."""
    lines = text.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(lines))
        line = lines[at]
        kind = rng.randrange(4)
        if kind == 0 and (b"=" in line or b":" in line):
            sign = b"=" if b"=" in line else b":"
            key, _, _ = line.partition(sign)
            comma = b"," if line.rstrip().endswith(b",") else b""
            lines[at] = key + sign + b" " + rng.choice(_VALUES) + comma
        elif kind == 1:
            del lines[at]
            lines = lines or [b""]
        elif kind == 2:
            lines.insert(rng.randrange(len(lines) + 1), line)
        else:
            lines.insert(at, rng.choice(_VALUES))
    return b"\n".join(lines)


def settings_target() -> FileTarget:
    """Return the fuzz target for profiles."""
    seeds = [path.read_bytes() for path in sorted((ROOT / "config").glob("*.toml"))]
    short = [b"[safety]\ncurrent_max = 1.0\n[tip]\nradius = 0.01\n", b'task.name = "demo"\n', b""]
    return FileTarget(load, SettingsError, short * 3 + seeds, ".toml")


def calibration_target() -> FileTarget:
    """Return the fuzz target for calibration files of a sensor with few cells."""
    rows, cols = 4, 5
    sensor = {"finger": "left", "label": "x", "rows": rows, "cols": cols, "full_count": 255}
    table = [[1.0 + 0.1 * column for column in range(cols)] for _ in range(rows)]
    steps = {
        "tare": {"date": "d", "zero": table, "noise": 0.5, "frames": 16},
        "equilibrate": {"date": "d", "gain": table, "dead": 0, "spread": 0.1, "residual": 0.01},
        "curve": {
            **{"date": "d", "kind": "power", "residual": 0.01},
            "coefficients": [1.1, 400.0, 0.0, 0.0],
        },
        "centre": {
            **{"date": "d", "centre": [0.001, 0.0], "rotation": 0.01},
            **{"scale": 1.0, "residual": 1e-4},
        },
        "modulus": {"date": "d", "modulus": 3e5, "offset": 0.0, "residual": 0.02},
    }
    whole = {"format": 1, "sensor": sensor | {"pitch": [0.001, 0.001]}, "date": "d", **steps}
    seeds = [json.dumps(whole, indent=1).encode(), json.dumps(whole).encode()]
    for name in steps:
        part = {key: value for key, value in whole.items() if key not in steps or key == name}
        seeds.append(json.dumps(part, indent=1).encode())
    return FileTarget(load_calibration, CalibrationFileError, seeds, ".json")


TARGETS: dict[str, Callable[[], Any]] = {
    "commands": CommandTarget,
    "settings": settings_target,
    "calibration": calibration_target,
}


def fuzz(name: str, count: int, seed: int) -> Counter[str]:
    """Send ``count`` inputs to a target and count the results; propagate unexpected exceptions."""
    target, rng, counts = TARGETS[name](), random.Random(seed), Counter[str]()
    try:
        for _ in range(count):
            before = rng.getstate()
            try:
                counts[target.give(rng)[0]] += 1
            except BaseException:
                rng.setstate(before)
                print(f"{name}, seed {seed}, input {sum(counts.values())}", file=sys.stderr)
                raise
    finally:
        target.close()
    return counts
