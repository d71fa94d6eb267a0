"""Publish computed states and serve commands on real sockets, without a hand or a daemon.

The tests of clients connect to these sockets and define the messages.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import msgpack
import numpy as np
import zmq

from softfinger.daemon.wire import schema
from tests.harness.golden_wire import sample

_STATE, _TACTILE, _EVENT = map(sample, (schema.STATE, schema.TACTILE, schema.EVENT))


def now() -> dict[str, Any]:
    return {"timestamp": time.time(), "mono_ns": time.monotonic_ns()}


def finger(t: float, side: int) -> dict[str, Any]:
    found: dict[str, Any] = _STATE[("left", "right")[side]] | {
        "q": 0.42 + 0.02 * side,
        "dq": 0.1 * math.cos(t),
        "current": 0.213,
        "temperature": 41.0,
        "voltage": 12.1,
        "goal_q": 0.44,
        "goal_current": 0.35,
        "d": 3.21e-3 + 0.1e-3 * side,
        "theta": math.radians(5.0) * math.sin(0.5 * t) * (1 - 2 * side),
        "force": 10.0 + 2.0 * math.sin(1.3 * t + side),
        "energy": 12.34e-3,
        "theta_std": math.radians(0.1),
        "force_std": 0.05,
        "frame_age_s": 0.012,
    }
    return found | dict.fromkeys(("shear_x", "shear_y", "tilt_y"), 0.0)


def state(t: float, seq: int) -> dict[str, Any]:
    return {
        **_STATE,
        **now(),
        "seq": seq,
        "compute_s": 11e-6,
        "wake_late_s": 3e-6,
        "overruns": 0,
        "behind_s": 0.0,
        "goal_force": 10.0,
        "goal_angle": math.radians(5.0),
        "left": finger(t, 0),
        "right": finger(t, 1),
        "object": {"valid": True, "angle": math.radians(4.98), "width": 0.04},
    }


def frame(t: float, side: int, size: int = 44) -> dict[str, Any]:
    y, x = np.mgrid[:size, :size] - (size - 1) / 2.0
    x = x - 6.0 * math.sin(0.5 * t) * (1 - 2 * side)
    # The peak is 42 kPa: the noise, 1.5 kPa per cell, never moves it beyond 40 to 50 kPa.
    shape = np.clip(1.0 - (x**2 + y**2) / 12.0**2, 0.0, None) * (42e3 / 4.0)
    noise = np.random.default_rng(int(t * 1000)).normal(0.0, 380.0, shape.shape)
    counts = np.clip(shape + noise, 0, 65535).astype("<u2")
    square = {"rows": size, "cols": size, "pitch": 0.058 / size, "pitch_y": 0.058 / size}
    middle = dict.fromkeys(("centre_x", "centre_y", "rotation"), 0.0)
    told = _TACTILE | now() | square | middle | {"finger": ("left", "right")[side]}
    told |= {"seq": int(t * 25), "seq_step": 1, "number": int(t * 25)}
    return told | {"data": counts.tobytes()}


def event(seq: int, kind: str, text: str, level: str = "info") -> dict[str, Any]:
    return _EVENT | now() | {"seq": seq, "level": level, "kind": kind, "text": text}


class FakeDaemon:
    """Publish states at 100 Hz and frames at 25 Hz until closed.

    ``changes`` are merged into every state. ``requests`` contains the received commands, and
    ``keys`` contains each command's client key. ``replies`` maps a command to its reply, or to a
    list of successive replies; a reply of bytes is sent unchanged. ``silent`` suppresses
    all states, ``deaf`` suppresses all replies, and ``dead`` names the fingers whose frames are
    suppressed.
    """

    def __init__(self) -> None:
        self.changes: dict[str, Any] = {}
        self.replies: dict[str, Any] = {}
        self.requests: list[dict[str, Any]] = []
        self.keys: list[str] = []
        self.silent = threading.Event()
        self.deaf = threading.Event()
        self.dead: set[str] = set()
        self.published = 0  # number of states published so far
        self._extra: list[list[bytes]] = []
        self._context: zmq.Context[Any] = zmq.Context()
        self._publisher = self._context.socket(zmq.PUB)
        self._server = self._context.socket(zmq.REP)
        self.state_address = self._bound(self._publisher)
        self.command_address = self._bound(self._server)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @staticmethod
    def _bound(socket: zmq.Socket[Any]) -> str:
        socket.setsockopt(zmq.LINGER, 0)
        return f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"

    def send(self, topic: bytes, payload: bytes) -> None:
        """Publish one message unchanged."""
        self._extra.append([topic, payload])

    def send_event(self, kind: str, text: str, level: str = "info") -> None:
        self.send(b"hand/event", msgpack.packb(event(1, kind, text, level)))

    def _run(self) -> None:
        began = time.monotonic()
        seq = 0
        while not self._over.wait(0.01):
            while not self.deaf.is_set() and self._server.poll(0):
                request = msgpack.unpackb(self._server.recv())
                self.keys.append(request.pop("key", ""))
                self.requests.append(request)
                reply = self.replies.get(request["command"], {"ok": True})
                if isinstance(reply, list):
                    reply = reply.pop(0)
                self._server.send(reply if isinstance(reply, bytes) else msgpack.packb(reply))
            while self._extra:
                self._publisher.send_multipart(self._extra.pop(0))
            if self.silent.is_set():
                continue
            t = time.monotonic() - began
            message = {**state(t, 5 * seq), **self.changes}
            self._publisher.send_multipart([b"hand/state", msgpack.packb(message)])
            if seq % 4 == 0:
                for side in (0, 1):
                    if ("left", "right")[side] in self.dead:
                        continue
                    payload = msgpack.packb(frame(t, side))
                    self._publisher.send_multipart([b"hand/tactile", payload])
            seq += 1
            self.published = seq

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def __enter__(self) -> FakeDaemon:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
