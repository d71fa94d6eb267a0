"""The recorder beside a daemon: ``softfinger run --record FILE`` starts it as a child process.

Holds that child's life only. It is subscribed before the first tick, so that nothing is missed, and
is told to end when the daemon has said its last word; should the daemon die, it ends as well. When
it ends by itself, that is told at once.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from softfinger.daemon.errors import SoftfingerError

_PATIENCE = 20.0  # s for a recorder to subscribe, or to close its file
_LOOK = 0.01  # s


class NoRecorder(SoftfingerError):
    """The recorder did not come up. The message says what it said."""


class RecorderBeside:
    """A recording of all that ``address`` publishes, from before the first message on.

    ``failed`` once it is known not to have all of it.
    """

    def __init__(
        self,
        path: Path,
        address: str,
        subscribed: Callable[[], bool],
        on_end: Callable[[str], None],
        keys: str = "",
    ) -> None:
        """``subscribed`` tells whether somebody takes everything. ``on_end`` is called, from a
        thread, when the recorder ends before it is told to, with why; ``keys`` is the folder of the
        client's, if the daemon wants some. Raises NoRecorder.
        """
        self.failed = False
        self._path = path
        self._on_end = on_end
        self._closing = False
        self._said = ""
        reads, self._lifeline = os.pipe()  # its end is the end of this process
        # -P: a folder named tools where the daemon was started is not ours.
        words = [sys.executable, "-P", "-m", "softfinger", "record", str(path)]
        words += ["--topics", "all", "--address", address, "--lifeline", str(reads)]
        if keys:
            words += ["--keys", keys]
        # A session of its own: Ctrl-C is the daemon's, whose last messages are to be recorded, too.
        self._process = subprocess.Popen(
            words,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            pass_fds=(reads,),
            start_new_session=True,
        )
        os.close(reads)
        deadline = time.monotonic() + _PATIENCE
        while not subscribed():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self._process.kill()
                said = " ".join(part.strip() for part in self._process.communicate())
                raise NoRecorder(said.strip() or "the recorder did not come up")
            time.sleep(_LOOK)
        self._watch = threading.Thread(target=self._wait, name="recorder", daemon=True)
        self._watch.start()

    def _wait(self) -> None:
        """Sleep until the recorder has ended, and say so if it was not to."""
        self._said = "".join(self._process.communicate()).strip()
        self.failed = not self._closing or self._process.returncode != 0
        if self._closing:
            return
        why = self._said.splitlines()[-1:] or ["it ended"]
        if self._process.returncode < 0:
            name = signal.Signals(-self._process.returncode).name
            why = [f"ended by {name}; `softfinger record --recover {self._path}` closes its file"]
        self._on_end(f"the recorder has ended, nothing is recorded any more: {why[0]}")

    def close(self) -> str:
        """Have the file closed; what the recorder says of it."""
        self._closing = True
        if self._watch.is_alive():
            self._process.send_signal(signal.SIGTERM)
        os.close(self._lifeline)
        self._watch.join(_PATIENCE)
        if self._watch.is_alive():
            self._process.kill()
            self._watch.join()
        return self._said

    def __enter__(self) -> RecorderBeside:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self._closing:
            self.close()
