"""Send commands to a daemon, either with `send` or with the methods of `HandClient`."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from numbers import Real
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgpack
import zmq

from softfinger import SoftfingerError
from softfinger.daemon.client.connection import (
    REPLY_TIMEOUT,
    SILENCE_TIME,
    OneThread,
    both_addresses,
    milliseconds,
    require_address,
    still_waiting,
)
from softfinger.daemon.errors import HandClosed, Reason, Refused
from softfinger.daemon.types import NO_LEASE_COMMANDS
from softfinger.daemon.wire.keys import ClientKeys, load_client
from softfinger.daemon.wire.local_stop import stop_locally
from softfinger.daemon.wire.loop_link import machine_time

_Done = TypeVar("_Done")

_log = logging.getLogger(__name__)

RETRY_DELAY = 0.05  # delay before a late command is sent again [s]
LOCAL_STOP_TIMEOUT = 0.5  # timeout for a stop over the local socket [s]
# Warning that is logged if ``torque_off`` is ``unconfirmed``.
UNCONFIRMED_TEXT = "the servos have not yet confirmed that torque is off"


class NoAnswer(SoftfingerError):
    """The daemon did not reply before the timeout."""


class Attempts:
    """Retry policy for one command.

    After a stall, the daemon refuses outdated commands with the reason ``late``. A refused command
    has no effect. All attempts use the same key, so the daemon executes the command at most once.
    If a stop or another command arrives between two attempts, the daemon refuses the second
    attempt.
    """

    def __init__(self, request: dict[str, Any], timeout: float) -> None:
        """Create a policy that limits the total duration of all attempts to ``timeout`` [s]."""
        harmless = request.get("command") in NO_LEASE_COMMANDS
        self.request = request if harmless else {**request, "key": secrets.token_hex(8)}
        self.timeout = timeout
        self._end = machine_time() + timeout

    def remaining(self) -> float:
        """Return the remaining time [s]."""
        return max(self._end - machine_time(), 0.0)

    def again(self, reply: dict[str, Any]) -> bool:
        """Return True if the command must be sent again after `RETRY_DELAY` [s]."""
        return reply.get("reason") == Reason.LATE and self.remaining() > 2.0 * RETRY_DELAY


def send(
    address: str,
    request: dict[str, Any],
    timeout: float = REPLY_TIMEOUT,
    keys: ClientKeys | None = None,
) -> dict[str, Any]:
    """Send one command and return the reply. Raises NoAnswer if no reply arrives in time.

    If the daemon refuses a late command, the client sends the command again until ``timeout``
    expires. If the reply takes longer than 1 s, a warning is logged. If no logging handler exists,
    the warning is printed to standard error. If the daemon runs on this machine under the same user
    account, ``stop`` is sent over a local socket. A stop on the local socket does not wait for the
    commands of other clients.
    """
    attempts = Attempts(request, timeout)
    reply = send_once(address, attempts, keys)
    while attempts.again(reply):
        time.sleep(RETRY_DELAY)
        if not attempts.remaining():  # The computer was suspended.
            break
        reply = send_once(address, attempts, keys)
    return reply


def send_once(address: str, attempts: Attempts, keys: ClientKeys | None = None) -> dict[str, Any]:
    """Send a command once and return the reply; see `send`."""
    request, timeout, remaining = attempts.request, attempts.timeout, attempts.remaining()
    if request.get("command") == "stop":
        stopped = stop_locally(address, min(remaining, LOCAL_STOP_TIMEOUT))
        if stopped is not None:
            return stopped
    answer = f"reply to {request['command']} from {address}"
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    try:
        if keys is not None:
            keys.guard(socket)
        try:
            socket.setsockopt(zmq.IPV6, int("[" in address))
            socket.connect(address)
        except zmq.ZMQError as error:
            raise NoAnswer(f"{address}: {error}") from None
        socket.send(msgpack.packb(request))
        silence = min(SILENCE_TIME, remaining)
        answered = socket.poll(milliseconds(silence))
        if not answered and silence < remaining:
            _log.warning(still_waiting(answer, timeout))
            answered = socket.poll(milliseconds(remaining - silence))
        if not answered:
            hint = " (if access.keys is set, pass --keys or keys=)" if keys is None else ""
            raise NoAnswer(
                f"no {answer} within {timeout:g} s; is softfinger running, or still starting?{hint}"
            )
        packed = socket.recv()
    finally:
        socket.close()
        context.term()
    with suppress(ValueError, RecursionError, msgpack.UnpackException):
        reply = msgpack.unpackb(packed)
        if isinstance(reply, dict):
            return reply
    raise NoAnswer(f"{address} sent an invalid reply")


def _number(what: str, value: Any) -> float:
    """Convert a number, a NumPy scalar or a 0-d array to a float that msgpack can encode.

    Raises Refused if the value has any other type.
    """
    if getattr(value, "shape", None) == ():
        value = value.item()
    try:
        if isinstance(value, Real) and not isinstance(value, bool):
            return float(value)
    except OverflowError:
        pass  # The integer is too large for a float.
    text = f"{what}: expected a number, found {type(value).__name__} {str(value)[:40]!r}"
    raise Refused(text, Reason.REQUEST)


def accepted(reply: dict[str, Any]) -> dict[str, Any]:
    """Return the reply without its ``ok`` field. Raises Refused if the daemon refused the command.

    A warning is logged if the servos have not confirmed that torque is off.
    """
    if reply.get("ok") is not True:
        text = str(reply.get("error", "rejected; the reply does not state a reason"))
        raise Refused(text, str(reply.get("reason", "")))
    if reply.get("torque_off") == "unconfirmed":
        _log.warning(UNCONFIRMED_TEXT)
    return {key: value for key, value in reply.items() if key != "ok"}


# Functions that return True if the status shows the state that the command would produce. For these
# commands, a refusal is then ignored.
IS_DONE: dict[str, Callable[[dict[str, Any]], bool]] = {
    "arm": lambda status: status.get("mode", "fault") not in ("disarmed", "fault"),
    "disarm": lambda status: status.get("torque") is False,
    "clear": lambda status: status.get("mode", "fault") != "fault",
}


class HandClient(Generic[_Done]):
    """Store the addresses and define the commands of `Hand` and `AsyncHand`.

    A command method raises Refused if the daemon refuses the command, and NoAnswer if the daemon
    does not reply. If the daemon refuses a late command, the client sends the command again until
    ``timeout`` expires. ``arm``, ``disarm``, ``clear`` and ``release`` may be repeated. For
    example, arming an armed hand is not an error.
    """

    _CONTEXT: type[zmq.Context[Any]] = zmq.Context
    _now = staticmethod(time.monotonic)  # clock used by `wait_for` [s]

    def __init__(
        self,
        stream: str | None = None,
        commands: str | None = None,
        *,
        client: str = "",
        timeout: float = REPLY_TIMEOUT,
        keys: Path | None = None,
    ) -> None:
        if not (stream and commands):
            # One address alone might select the stream of one hand and the commands of another.
            stream, commands = both_addresses(stream or commands or "")
        self.stream_address, self.command_address = stream, commands
        for address in (self.stream_address, self.command_address):
            require_address(address)
        self.client = client
        self.timeout = timeout
        self._keys = None if keys is None else load_client(keys)
        self._thread = OneThread()
        self._context = self._CONTEXT()
        if self._keys is not None:
            self._keys.guard(self._context)

    def __repr__(self) -> str:
        ended = ", closed" if self._context.closed else ""
        return f"{type(self).__name__}: {self.stream_address}, {self.command_address}{ended}"

    def close(self) -> None:
        """Close all sockets and subscriptions. The state of the hand does not change."""
        self._thread.claim()
        self._context.destroy(linger=0)

    def _require_open(self) -> None:
        if self._context.closed:
            raise HandClosed(f"this {type(self).__name__} is closed: create a new one")

    def _request(self, name: str, numbers: dict[str, float | None]) -> dict[str, Any]:
        self._require_open()
        given = {
            key: _number(f"{name}: {key}", value)
            for key, value in numbers.items()
            if value is not None
        }
        envelope = {"client": self.client} if self.client else {}
        return {"command": name, **given, **envelope}

    def _carry_out(self, command: str, **numbers: float | None) -> _Done:
        raise NotImplementedError

    def arm(self) -> _Done:
        """Switch the torque on. The joints hold their positions."""
        return self._carry_out("arm")

    def disarm(self) -> _Done:
        """Switch the torque off."""
        return self._carry_out("disarm")

    def tare(self) -> _Done:
        """Use the current readings of the unloaded sensors as zero offsets."""
        return self._carry_out("tare")

    def move(self, left: float | None = None, right: float | None = None) -> _Done:
        """Move one or both joints to the given angles [rad]."""
        return self._carry_out("move", left=left, right=right)

    def grasp(self, force: float | None = None) -> _Done:
        """Close the fingers and grip with ``force`` [N] per tip.

        The default force is ``control.force_default``.
        """
        return self._carry_out("grasp", force=force)

    def rotate(self, angle: float) -> _Done:
        """Rotate the grasped object to ``angle`` [rad] in the hand's frame."""
        return self._carry_out("rotate", angle=angle)

    def hold(self, force: float | None = None, angle: float | None = None) -> _Done:
        """Send one setpoint; call this method repeatedly, for example at 50 to 100 Hz.

        Pass the ``force`` [N] per tip, the object ``angle`` [rad], or both. If the hand is not
        gripping yet, the first setpoint starts a grasp. The daemon limits the angle to the range
        that this grip can reach. The daemon limits the rate of rotation to
        ``control.rotate_speed``.
        """
        return self._carry_out("hold", force=force, angle=angle)

    def release(self) -> _Done:
        """Open the fingers."""
        return self._carry_out("release")

    def set(self, **numbers: float) -> _Done:
        """Set the grip's rotational ``compliance`` [rad/(N·m)]."""
        return self._carry_out("set", **numbers)

    def stop(self) -> _Done:
        """Switch the torque off immediately, in any mode."""
        return self._carry_out("stop")

    def clear(self) -> _Done:
        """Clear a latched fault after its cause has been removed."""
        return self._carry_out("clear")
