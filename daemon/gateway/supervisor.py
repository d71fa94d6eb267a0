"""Start the gateway process and restart it if it exits unexpectedly."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
import time
from pathlib import Path

from softfinger.daemon.errors import AddressError
from softfinger.daemon.gateway.bounds import READY, Config
from softfinger.daemon.wire.loop_link import Channel, Link, pair

_ROOT = Path(__file__).parents[3]  # parent folder of the package
_BIND_TIMEOUT = 60.0  # timeout for binding the sockets [s]
_SUSPENSION_TIME_MAX = 1.5  # time after which a suspended process is killed [s]
_RESTART_DELAY = 0.1  # minimum time between an exit and the next start [s]
_START_INTERVAL = 2.0  # minimum time between two starts [s]


class Gateway:
    """Gateway process that is restarted if it exits before `close` is called.

    The loop communicates through `link`.
    """

    def __init__(self, config: Config, link: Link | None = None) -> None:
        """Start the process in the background. Call `wait` before use."""
        self.link = link or Link()
        self._config = config
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="gateway", daemon=True)
        self._start()

    def wait(self) -> None:
        """Wait until the gateway is ready. Raises AddressError if the sockets can't be bound."""
        self._connect()
        self._thread.start()

    def _start(self) -> None:
        ours, theirs = pair()
        paths = [str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            # The -P option keeps Python from importing a folder named daemon in the working
            # directory.
            words = [sys.executable, "-P", "-m", f"{__package__}.server", str(theirs.fileno())]
            self.process = subprocess.Popen(
                [*words, json.dumps(self._config)],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                # The process runs in its own session, so Ctrl-C does not end the process before the
                # daemon's last messages have been sent.
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            )
        self._channel = Channel(ours)

    def _connect(self) -> None:
        """Wait until the process is ready, then connect the link. Raises AddressError."""
        assert self.process.stdout is not None
        output, text = self.process.stdout.fileno(), b""
        if select.select([output], [], [], _BIND_TIMEOUT)[0]:
            text = os.read(output, select.PIPE_BUF)
        if text.strip() != READY.encode():
            raise AddressError(text.decode().strip() or "the gateway process did not start")
        self.link.offer(self._channel)

    def _watch(self) -> None:
        error_before, start_at = "", time.monotonic() + _START_INTERVAL
        self._wait()
        while not self._closing.wait(max(start_at - time.monotonic(), _RESTART_DELAY)):
            start_at = time.monotonic() + _START_INTERVAL
            # Requests that clients have queued since are older than the stops after this count.
            stops = self.link.confirmed
            self._config = self._config._replace(restarted=True, stops=stops)
            try:
                self._start()
                if self._closing.is_set():  # `close` has closed only the previous channel.
                    self._channel.close()
                self._connect()
                error_before = ""
                self._wait()
            except (AddressError, OSError) as error:
                self._kill()
                if str(error) != error_before:
                    error_before = str(error)
                    self.link.notices.append(f"the gateway can't start: {error}")

    def _wait(self) -> None:
        """Wait for the process to exit, and report the reason.

        A suspended process is killed, because its timers don't run.
        """
        process = self.process
        with contextlib.suppress(ChildProcessError):  # `close` has already waited for the process.
            while _is_suspended(process.pid):
                self._closing.wait(_SUSPENSION_TIME_MAX)
                if _is_suspended(process.pid, os.WNOHANG):
                    self.link.notices.append("the gateway process was suspended")
                    process.kill()
        text, status = process.communicate()[0].decode().strip(), process.returncode
        cause = f"signal {-status}" if status < 0 else f"status {status}"
        if not self._closing.is_set():
            self.link.notices.append(text or f"the gateway process exited ({cause})")

    def _kill(self) -> None:
        self._channel.close()
        with self.process as process:  # `Popen.__exit__` closes the pipe and waits for the process.
            process.kill()

    def close(self) -> None:
        """Disconnect, and wait until the gateway has sent all messages and exited."""
        self._closing.set()
        self.link.close()
        self._channel.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(2.0)
        self.process.kill()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._kill()


def _is_suspended(process: int, options: int = 0) -> bool:
    """Wait until a child process is suspended or has exited; return True if it is suspended."""
    states = os.WEXITED | os.WSTOPPED | os.WNOWAIT
    found = os.waitid(os.P_PID, process, states | options)
    return found is not None and found.si_code == os.CLD_STOPPED
