"""Run the monitor and the recorder as child processes of the daemon.

Each child reads from a pipe that only the daemon keeps open for writing. If the daemon exits for
any reason, the pipe closes and the child exits too.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from typing import Any

from softfinger.daemon.errors import SoftfingerError

_RECORDER_TIMEOUT = 20.0  # time limit for a recorder to subscribe or to close its file [s]


class RecorderError(SoftfingerError):
    """Error raised if the recorder does not start. The error text is the recorder's own message."""


class _Lifeline:
    """Pipe to a child process, which exits when the pipe closes."""

    def start(self, words: list[str], keys: str, **options: Any) -> subprocess.Popen[Any]:
        """Start ``softfinger`` with the arguments ``words`` and, if keys are set, ``--keys``."""
        reads, self._ours = os.pipe()
        # The -P option keeps Python from importing a folder named tools in the working directory.
        command = [sys.executable, "-P", "-m", "softfinger", *words, "--lifeline", str(reads)]
        try:
            return subprocess.Popen(
                [*command, *(("--keys", keys) if keys else ())], pass_fds=(reads,), **options
            )
        except BaseException:
            self.close()
            raise
        finally:
            os.close(reads)

    def close(self) -> None:
        """Close the pipe, so that the child exits."""
        if self._ours >= 0:
            os.close(self._ours)
            self._ours = -1


class MonitorProcess:
    """Run the monitor on this process's terminal until `close` is called.

    When the monitor exits, ``on_end`` is called once, from a signal handler in the main thread.
    With ``on_end=loop.end``, the monitor's q key stops the daemon.
    """

    def __init__(
        self, stream: str, commands: str, on_end: Callable[[], None], keys: str = ""
    ) -> None:
        self._attributes: list[Any] | None = None
        # Standard output may be closed or may have no file descriptor.
        with contextlib.suppress(termios.error, AttributeError, OSError, ValueError):
            self._terminal = sys.stdout.fileno()
            self._attributes = termios.tcgetattr(self._terminal)
        self._lifeline = _Lifeline()
        words = ["monitor", "--address", f"{stream},{commands}"]
        self.process = self._lifeline.start(words, keys)
        called = False

        # This handler is also called when a child is stopped or continued.
        def child_changed(*_: Any) -> None:
            nonlocal called
            if not called and self.process.poll() is not None:
                called = True
                on_end()

        signal.signal(signal.SIGCHLD, child_changed)
        child_changed()  # The monitor may have exited before the handler was installed.

    def close(self, patience: float = 2.0) -> None:
        """End the monitor if it is running, and wait until it has restored the terminal.

        This method never raises an exception.
        """
        self._lifeline.close()
        for end in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(patience)
                break
            except subprocess.TimeoutExpired:
                end()
        # A killed monitor leaves its page on the screen.
        if self.process.wait() < 0 and self._attributes is not None:
            from softfinger.tools.terminal.terminal import LEAVE  # slow import, rarely needed

            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._terminal, termios.TCSANOW, self._attributes)
                os.write(self._terminal, LEAVE.encode())

    def __enter__(self) -> MonitorProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RecorderProcess:
    """Run ``record`` with the arguments ``words``; the first argument is the file name.

    ``failed`` is set as soon as an incomplete recording is detected.
    """

    def __init__(
        self,
        words: list[str],
        subscribed: Callable[[], bool],
        on_end: Callable[[str], None],
        keys: str = "",
    ) -> None:
        """Start the recorder and wait until ``subscribed()`` is True. Raises RecorderError.

        If the recorder exits before `close` is called, another thread calls ``on_end`` with the
        reason.
        """
        self.failed = False
        self._path = words[0]
        self._on_end = on_end
        self._closing = False
        self._said = ""
        self._lifeline = _Lifeline()
        # The recorder runs in its own session, so Ctrl-C does not reach it. The recorder can
        # therefore record the daemon's last messages.
        self._process = self._lifeline.start(
            ["record", *words],
            keys,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        deadline = time.monotonic() + _RECORDER_TIMEOUT
        while not subscribed():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self._process.kill()
                output = " ".join(text.strip() for text in self._process.communicate())
                raise RecorderError(output.strip() or "the recorder did not start")
            time.sleep(0.01)
        self._watch = threading.Thread(target=self._wait, name="recorder", daemon=True)
        self._watch.start()

    def _wait(self) -> None:
        """Wait until the recorder exits, and report an unexpected exit."""
        self._said = "".join(self._process.communicate()).strip()
        self.failed = not self._closing or self._process.returncode != 0
        if self._closing:
            return
        why = self._said.splitlines()[-1:] or ["it ended"]
        if self._process.returncode < 0:
            name = signal.Signals(-self._process.returncode).name
            why = [f"ended by {name}; `softfinger record --recover {self._path}` repairs its file"]
        self._on_end(f"the recorder has exited, so recording has stopped: {why[0]}")

    def close(self) -> str:
        """End the recording and return the recorder's summary."""
        self._closing = True
        if self._watch.is_alive():
            self._process.send_signal(signal.SIGTERM)
        self._lifeline.close()
        self._watch.join(_RECORDER_TIMEOUT)
        if self._watch.is_alive():
            self._process.kill()
            self._watch.join()
        return self._said
