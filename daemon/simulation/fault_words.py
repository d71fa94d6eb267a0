"""Words of text that say what shall go wrong with the stand-in hand, sorted to its parts."""

from __future__ import annotations

import math
from collections.abc import Iterable

from daemon.records import FINGERS
from daemon.simulation.bus_faults import SERVO_FAULTS, FaultError, parse_fault
from daemon.simulation.tactile_board import BoardFault


class Faults:
    """What shall go wrong: sorted from words of text to the servos and to each board.

    - ``torn``, ``noisy``, ``silent``, ``frozen``, ``wrong-size`` for both boards, with ``left:`` or
      ``right:`` before it for one; see :class:`BoardFault`.
    - ``drop=0.01``, ``silent=2`` … for the servos; see :meth:`ServoBus.fault`.
    - ``unplug`` and ``plug`` for the servos' port.

    ``@SECONDS`` behind it says when it starts.
    """

    def __init__(self, words: Iterable[str], ids: tuple[int, ...]) -> None:
        """Raises FaultError for a word that can't be understood."""
        self.boards: tuple[list[BoardFault], list[BoardFault]] = ([], [])
        self.servos: list[tuple[float, str]] = []  # (start [s], fault), in time's order
        for word in words:
            self._add(word.strip(), ids)
        self.servos.sort()

    def _add(self, word: str, ids: tuple[int, ...]) -> None:
        side, colon, rest = word.partition(":")
        if colon:
            if side not in FINGERS:
                raise FaultError(f"fault {word!r}: expected left: or right:, found {side}:")
            self.boards[FINGERS.index(side)].append(BoardFault.parse(rest))
            return
        kind = word.partition("@")[0].partition("=")[0]
        if kind in BoardFault.KINDS and not word.startswith("silent="):
            for board in self.boards:
                board.append(BoardFault.parse(word))
            return
        text, _, start = word.partition("@")
        try:
            after = float(start or "0")
        except ValueError:
            after = math.nan
        if not 0.0 <= after < math.inf:
            raise FaultError(f"fault {word!r}: {start!r} is no time in seconds")
        if text not in ("plug", "unplug"):
            kind, number = self._parse(text)
            if kind in SERVO_FAULTS and number not in ids:
                raise FaultError(f"fault {word!r}: no servo has that ID")
        self.servos.append((after, text))

    def _parse(self, text: str) -> tuple[str, float]:
        try:
            return parse_fault(text)
        except FaultError as error:
            boards = ", ".join(BoardFault.KINDS)
            raise FaultError(f"{error}; or for tactile boards {boards}") from None
