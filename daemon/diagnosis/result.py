"""What a check found: one line and, unless all is well, the command that fixes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["pass", "note", "fixed", "warn", "FAIL"]


@dataclass(frozen=True, slots=True)
class Result:
    """``FAIL`` keeps the daemon from working, ``warn`` makes it work worse, the others are well."""

    status: Status
    subject: str  # what was looked at
    text: str  # what was found
    fix: str = ""  # a command, or what to do by hand; empty when nothing is to be done

    @property
    def failed(self) -> bool:
        """Whether the daemon can't work like this."""
        return self.status == "FAIL"
