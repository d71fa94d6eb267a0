"""Run emulated hands in a thread or process, and access their servos with the SDK."""

from __future__ import annotations

import contextlib
import re
import select
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler, PortHandler

from softfinger.daemon.clock import RealClock
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator.emulator import Emulator
from softfinger.daemon.tactile.flexitac import FlexiTac
from softfinger.tools.cli import main
from tests.harness.daemon_process import started

HIL = Path(__file__).parents[2] / "config" / "hil.toml"
_COMPILED = re.compile(r"^(compil(ing|ed) .*|.*: \d+ of about \d+, .*)\n", re.MULTILINE)
READY_WITHIN = 200.0  # time limit for the start [s], which includes kernel compilation


@contextlib.contextmanager
def emulated(
    folder: Path, *faults: str, settings: Settings | None = None, **options: Any
) -> Iterator[Emulator]:
    """Run an emulator in a thread; enter the context once the emulator is ready."""
    made = Emulator(settings or Settings(), folder, faults=faults, **options)
    ready = threading.Event()
    runner = threading.Thread(target=made.run, args=(ready.set,), daemon=True)
    runner.start()
    try:
        assert ready.wait(READY_WITHIN)
        yield made
    finally:
        made.end()
        runner.join()
        made.close()


class EmulatorProcess:
    """A ``softfinger emulate`` process with the given arguments."""

    def __init__(self, *arguments: str | Path) -> None:
        self.popen = started("emulate", *arguments)

    def ready(self) -> EmulatorProcess:
        """Wait for the first line, which must be ``ready``."""
        found = select.select([self.popen.stdout], [], [], READY_WITHIN)[0]
        line = self.popen.stdout.readline() if found else "nothing"
        if line != "ready\n":
            self.popen.kill()
            raise AssertionError(f"{line!r} instead of ready: {self.popen.communicate()[1]}")
        return self

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Send a signal; return the exit status, and the output without compilation messages."""
        self.popen.send_signal(number)
        out, err = self.popen.communicate(timeout=300)
        return self.popen.returncode, out, _COMPILED.sub("", err)

    def __enter__(self) -> EmulatorProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.returncode is None:
            self.popen.kill()
            self.popen.communicate()


class PatientPort(PortHandler):
    """Port with a reply timeout of one minute, because the SDK's 34 ms may be too short."""

    patience = 60_000.0  # ms

    def setPacketTimeout(self, _: int) -> None:
        self.setPacketTimeoutMillis(self.patience)


class SdkServos:
    """Access to the emulated servos through the manufacturer's SDK."""

    def __init__(self, folder: Path) -> None:
        self.port = PatientPort(str(folder / "servos"))
        assert self.port.openPort()
        assert self.port.setBaudRate(2_000_000)
        self.packets = PacketHandler(2.0)

    def ping(self, servo: int) -> int:
        """Return the servo's model number."""
        model, result, _ = self.packets.ping(self.port, servo)
        assert result == COMM_SUCCESS
        return int(model)

    def silent(self, servo: int) -> bool:
        """Return True if the servo does not reply."""
        self.port.patience = 100.0
        _, result, _ = self.packets.ping(self.port, servo)
        self.port.patience = PatientPort.patience
        return bool(result == COMM_RX_TIMEOUT)

    def read(self, servo: int, address: int, size: int) -> int:
        data, result, error = self.packets.readTxRx(self.port, servo, address, size)
        assert (result, error) == (COMM_SUCCESS, 0)
        return int.from_bytes(data, "little")

    def write(self, servo: int, address: int, size: int, value: int) -> None:
        data = list(value.to_bytes(size, "little"))
        done = self.packets.writeTxRx(self.port, servo, address, size, data)
        assert done == (COMM_SUCCESS, 0)

    def close(self) -> None:
        self.port.closePort()


def board(folder: Path, finger: int, **changes: object) -> FlexiTac:
    """Open the daemon's backend for one board of the emulated hand."""
    tactile = load(HIL, folder).tactile
    tactile = tactile.model_copy(update={"open_timeout": 60.0, **changes})
    return FlexiTac(tactile, RealClock(), finger)


def send(folder: Path, words: str) -> int:
    """Run ``softfinger emulate --send`` and return its exit status."""
    return main(["emulate", "--dir", str(folder), "--send", words])
