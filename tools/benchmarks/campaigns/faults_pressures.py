"""Pressures on the daemon from outside: clients, subscribers, a recorder, no memory.

Each is a context that presses from its beginning to its end.
"""

from __future__ import annotations

import contextlib
import random
import resource
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import zmq

from softfinger.tools.benchmarks.campaigns.faults_rig import SOFTFINGER, Rig
from softfinger.tools.benchmarks.framework.campaign import RigError

_FLOODERS = 4
_STUCK = 5
_GARBAGE = 150  # messages
_LONGEST = 20_000  # bytes of one
_DISK = 30_000  # bytes that a recording may have
_ROOM = 1 << 18  # bytes that a daemon without memory may still take
_COMMANDS = ("status", "status", "clear", "arm", "tare")  # none moves a hand that holds


@contextlib.contextmanager
def flood(rig: Rig, chance: random.Random) -> Iterator[None]:
    """Clients that send commands as fast as they can and read the replies when it suits them."""
    ending = threading.Event()
    words = [{"command": chance.choice(_COMMANDS), "client": "flood"} for _ in range(64)]
    packed = [msgpack.packb(each) for each in words]

    def send() -> None:
        sockets = [rig.context.socket(zmq.DEALER) for _ in range(_FLOODERS)]
        for each in sockets:
            each.setsockopt(zmq.LINGER, 0)
            each.setsockopt(zmq.SNDHWM, 1000)
            each.connect(rig.commands)
        while not ending.is_set():
            for each in sockets:
                with contextlib.suppress(zmq.Again):
                    for payload in packed:
                        each.send_multipart([b"", payload], zmq.NOBLOCK)
                with contextlib.suppress(zmq.Again):
                    for _ in range(32):
                        each.recv_multipart(zmq.NOBLOCK)
            ending.wait(0.001)  # the interpreter is shared with the trial's own looks
        for each in sockets:
            each.close()

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        ending.set()
        sender.join()


@contextlib.contextmanager
def garbage(rig: Rig, chance: random.Random) -> Iterator[None]:
    """Random, mutated and oversized messages, and bytes that are no message at all."""
    dealer = rig.context.socket(zmq.DEALER)
    dealer.setsockopt(zmq.LINGER, 0)
    dealer.connect(rig.commands)
    raw = socket.socket(socket.AF_UNIX)
    try:
        for _ in range(_GARBAGE):
            frames = [_junk(chance) for _ in range(chance.choice((1, 1, 1, 2, 3, 9)))]
            with contextlib.suppress(zmq.Again):
                dealer.send_multipart([b"", *frames] if chance.random() < 0.5 else frames, 1)
        raw.connect(rig.commands.removeprefix("ipc://"))
        with contextlib.suppress(OSError):
            raw.sendall(chance.randbytes(chance.randrange(1, 4096)))
        yield
    finally:
        raw.close()
        dealer.close()


def _junk(chance: random.Random) -> bytes:
    kind = chance.randrange(4)
    if kind == 0:
        return chance.randbytes(chance.randrange(64))
    if kind == 1:
        return chance.randbytes(_LONGEST)
    packed = bytearray(msgpack.packb({"command": chance.choice(_COMMANDS), "force": 5.0}))
    if kind == 2:
        for _ in range(chance.randrange(1, 4)):
            packed[chance.randrange(len(packed))] = chance.randrange(256)
        return bytes(packed[: chance.randrange(len(packed))])
    strange: list[Any] = [None, 7, [], {}, {"command": 1}, {"command": "x" * 5000}, {1: 2}]
    return bytes(msgpack.packb(chance.choice(strange)))


@contextlib.contextmanager
def stuck(rig: Rig, chance: random.Random) -> Iterator[None]:
    """Subscribers to everything that never read."""
    sockets = []
    for _ in range(_STUCK):
        each = rig.context.socket(zmq.SUB)
        each.setsockopt(zmq.LINGER, 0)
        each.setsockopt(zmq.RCVHWM, 1)
        each.setsockopt(zmq.RCVBUF, 4096)
        each.subscribe(b"")
        each.connect(rig.stream)
        sockets.append(each)
    try:
        yield
    finally:
        for each in sockets:
            each.close()


@contextlib.contextmanager
def full_disk(rig: Rig, chance: random.Random) -> Iterator[None]:
    """A recorder whose disk is full after some tens of kilobytes; it must end with the reason."""
    path = rig.folder / "full.mcap"
    path.unlink(missing_ok=True)

    def small() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (_DISK, _DISK))

    recorder = subprocess.Popen(
        [*SOFTFINGER, "record", str(path), "--address", rig.stream],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=small,
    )
    try:
        _, errors = recorder.communicate(timeout=60.0)
        yield
    finally:
        if recorder.poll() is None:
            recorder.kill()
            recorder.communicate()
    if recorder.returncode != 1 or "File too large" not in errors:
        raise RigError(f"the recorder ended with {recorder.returncode}: {errors[-200:]}")


@contextlib.contextmanager
def no_memory(rig: Rig, chance: random.Random) -> Iterator[None]:
    """The daemon may take next to no address space any more, and is asked meanwhile."""
    assert rig.daemon is not None
    process = rig.daemon.pid
    _, hard = resource.prlimit(process, resource.RLIMIT_AS)
    with open(f"/proc/{process}/statm", encoding="ascii") as file:  # noqa: PTH123
        size = int(file.read().split()[0]) * resource.getpagesize()
    resource.prlimit(process, resource.RLIMIT_AS, (size + _ROOM, hard))
    try:
        for _ in range(5):
            rig.status()
            time.sleep(chance.uniform(0.0, 0.02))
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(process, resource.RLIMIT_AS, (hard, hard))


@contextlib.contextmanager
def stood_still(rig: Rig, seconds: float) -> Iterator[None]:
    """The daemon's process is stopped for so long, then goes on."""
    assert rig.daemon is not None
    process = rig.daemon
    process.send_signal(signal.SIGSTOP)
    timer = threading.Timer(seconds, process.send_signal, (signal.SIGCONT,))
    timer.start()
    try:
        yield
    finally:
        timer.join()
