"""How long a client waits for a daemon, and what it says meanwhile."""

from __future__ import annotations

from typing import Any

PATIENCE = 5.0  # s, unless it was told otherwise
SILENCE = 1.0  # s of that after which it says what it waits for


def answer_to(request: dict[str, Any], address: str) -> str:
    """What a client that has sent this waits for."""
    return f"answer to {request['command']} from {address}"


def still_waiting(what: str, timeout: float) -> str:
    """What is said of that after a while."""
    return f"no {what} yet, waiting up to {timeout:g} s"
