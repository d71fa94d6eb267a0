"""Backends of installed packages: found by entry points, and guarded, so that one that breaks is a
fault with its name on it and takes neither the loop nor the other backends down.

A plugin is a class (a function for a shape) that is called as the built-in ones are. It may have

- ``metal``: it is real hardware (True unless it says otherwise; a shape never is),
- ``hand``: it needs the simulated hand, which it then is given as the built-in ones are,
- ``Settings``: a pydantic model, best derived from `profile.settings.Section`, of the profile's
  table ``[plugins.NAME]``; the validated settings are its last argument.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from softfinger.daemon.errors import ServoError, SoftfingerError, TactileError
from softfinger.daemon.types import Frame, Goal, Reading

if TYPE_CHECKING:
    from softfinger.daemon.backends import Backend

_log = logging.getLogger(__name__)


def described(error: BaseException) -> str:
    """An error of a stranger's code, in a line."""
    return f"{type(error).__name__}: {error}".rstrip(": ")


class _Guard:
    """Makes a plugin's object; what that raises becomes ``ERROR``, with the plugin's name."""

    ERROR: type[SoftfingerError]

    def __init__(self, backend: Backend, given: tuple[Any, ...]) -> None:
        self._source = backend.source
        self._made = self._call(lambda: backend.load()(*given))

    def _call(self, function: Callable[..., Any], *given: Any) -> Any:
        try:
            return function(*given)
        except self.ERROR:
            raise
        except Exception as error:
            raise self.ERROR(f"{self._source}: {described(error)}") from error

    def counters(self) -> dict[str, int]:
        """Its own, by kind."""
        counters: dict[str, int] = self._call(self._made.counters)
        return counters

    def close(self) -> None:
        """Never raises."""
        try:
            self._made.close()
        except Exception as error:
            _log.error("%s, closing: %s", self._source, described(error))


class GuardedServos(_Guard):
    """A plugin's servos as `Servos`: whatever they raise is a ServoError, which the loop knows."""

    ERROR = ServoError

    def connect(self) -> None:
        """As the servos' own. Raises ServoError."""
        self._call(self._made.connect)

    def read(self, reading: Reading) -> None:
        """As the servos' own. Raises ServoError."""
        self._call(self._made.read, reading)

    def torque_on(self) -> None:
        """As the servos' own. Raises ServoError."""
        self._call(self._made.torque_on)

    def torque_off(self, reading: Reading) -> bool:
        """As the servos' own. Raises ServoError."""
        return bool(self._call(self._made.torque_off, reading))

    def write(self, goal: Goal) -> None:
        """As the servos' own. Raises ServoError."""
        self._call(self._made.write, goal)


class GuardedSensor(_Guard):
    """A plugin's board as a `TactileSensor`.

    A frame of another shape or type, and what it raises in the tick, are counted as ``refused``:
    the board is silent then, and the limits notice.
    """

    ERROR = TactileError

    def __init__(self, backend: Backend, given: tuple[Any, ...], rows: int, cols: int) -> None:
        super().__init__(backend, given)
        self._shape = (rows, cols)
        self._seen: Frame | None = None
        self._sound: Frame | None = None
        self._refused = 0

    def open(self) -> None:
        """As the board's own. Raises TactileError."""
        self._call(self._made.open)

    def latest(self) -> Frame | None:
        """The newest sound frame."""
        try:
            frame = self._made.latest()
            if frame is not None and frame is not self._seen:
                self._seen = frame
                self._check(frame)
                self._sound = frame
        except Exception as error:
            self._refused += 1
            if self._refused == 1:
                _log.error("%s: %s; counted from now on", self._source, described(error))
        return self._sound

    def _check(self, frame: Frame) -> None:
        data = frame.data
        if data.shape != self._shape or data.dtype != np.uint16:
            raise ValueError(f"a frame of {data.dtype} {data.shape}, expected uint16 {self._shape}")

    def counters(self) -> dict[str, int]:
        """Its own, and ``refused``."""
        return {**super().counters(), "refused": self._refused}
