"""Start the gateway process and restart it if it dies."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
from pathlib import Path

from softfinger.daemon.errors import AddressError
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.wire import loop_link
from softfinger.daemon.wire.loop_link import Channel, Link

_ROOT = Path(__file__).parents[3]  # parent folder of the package
_BIND_TIMEOUT = 60.0  # timeout for binding the sockets [s]
_STABLE_TIME = 10.0  # running time after which the restart delay is reset [s]
# Interval between checks [s], and number of consecutive checks in the stopped state after which a
# process is killed.
_CHECK_INTERVAL, _STOPPED_COUNT_MAX = 1.0, 2
_RESTART_DELAYS = 0.1, 2.0  # first and maximum delay between an exit and the next start [s]


class Gateway:
    """Gateway process, which is restarted whenever it dies until `close` is called.

    The loop communicates through `link`.
    """

    def __init__(self, config: Config, link: Link | None = None) -> None:
        """Start the process in the background. Call `wait` before use."""
        self.link = link or Link()
        self._config = config
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._process, self._channel = self._start()

    def wait(self) -> Gateway:
        """Wait until the gateway is ready. Raises AddressError if the sockets can't be bound."""
        self._meet()
        self._thread = threading.Thread(target=self._watch, name="gateway", daemon=True)
        self._thread.start()
        return self

    @property
    def process(self) -> int:
        return self._process.pid

    def _start(self) -> tuple[subprocess.Popen[bytes], Channel]:
        ours, theirs = loop_link.pair()
        paths = [str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            # The option -P keeps Python from importing a folder named daemon in the working
            # directory.
            words = [sys.executable, "-P", "-m", f"{__package__}.server", str(theirs.fileno())]
            process = subprocess.Popen(
                [*words, json.dumps(self._config)],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # The process runs in its own session, so that Ctrl-C does not end it before it has
                # sent the daemon's last messages.
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            )
        return process, Channel(ours)

    def _meet(self) -> None:
        """Wait until the process has bound its sockets. Raises AddressError."""
        select.select([self._channel], [], [], _BIND_TIMEOUT)
        for kind, *fields in self._channel.receive():
            if kind == loop_link.READY:
                self.link.offer(self._channel)
                return
            raise AddressError(*fields)
        raise AddressError("the gateway process did not start")

    def _watch(self) -> None:
        wait, longest = _RESTART_DELAYS
        while True:
            began = time.monotonic()
            status = self._wait()
            if self._closing.is_set():
                return
            if status != loop_link.RESTART_STATUS:
                cause = f"signal {-status}" if status < 0 else f"status {status}"
                self.link.notices.append(f"the gateway process ended ({cause})")
            if time.monotonic() - began > _STABLE_TIME:
                wait = _RESTART_DELAYS[0]
            error_before = ""
            while not self._closing.wait(wait):
                wait = min(2.0 * wait, longest)
                try:
                    self._process, self._channel = self._start()
                    self._meet()
                except (AddressError, OSError) as error:
                    self._kill()
                    if str(error) != error_before:
                        error_before = str(error)
                        self.link.notices.append(f"the gateway can't start: {error}")
                else:
                    break
            if self._closing.is_set():  # `close` was called during the restart.
                self._channel.close()

    def _wait(self) -> int:
        """Wait for the process to end.

        A stopped process is killed, because its timers don't run.
        """
        process, stopped = self._process, 0
        while True:
            try:
                return process.wait(_CHECK_INTERVAL)
            except subprocess.TimeoutExpired:
                stopped = stopped + 1 if _is_stopped(process.pid) else 0
            if stopped == _STOPPED_COUNT_MAX:
                self.link.notices.append("the gateway process was suspended")
                process.kill()

    def _kill(self) -> None:
        self._channel.close()
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Disconnect, and wait until the gateway has sent all messages and exited."""
        self._closing.set()
        self.link.close()
        self._channel.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._kill()
        if self._thread is not None:
            self._thread.join(2.0)


def _is_stopped(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="latin-1").rpartition(")")[2]
    except OSError:  # The process has ended.
        return False
    return state.split()[0] in "Tt"
