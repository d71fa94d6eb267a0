"""The door before Foxglove's server: who may come in, how many, and who is shown out.

The SDK's server takes whoever connects, any web page too, and hangs for good where many clients
read nothing. So it listens at an address of this machine that nobody can guess, and what comes to
the known one is looked at here, passed on, and read from in its stead.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
from socket import SO_SNDBUF, SOL_SOCKET

from softfinger.tools.viewing.live_stream import LOOPBACK

CLIENTS = 8
_HOSTS = (LOOPBACK, "localhost")
# Foxglove in the browser, and on the desktop; browsers call a page from a file "null".
_ORIGINS = ("", "https://app.foxglove.dev", "file://")
_HEAD = 8192  # bytes of a request's head
_PATIENCE = 2.0  # s for the head, and for a client to take something
_PIECE = 65536  # bytes
_BUFFER = 256 << 10  # bytes that wait for a client
_CONNECTIONS = 64  # with those that have not said yet what they want


def hidden_host() -> str:
    """Return an address of the loopback, one of 16 million."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


class Door:
    """Listens on ``port`` of the loopback, 0 for a free one, until it is closed.

    ``inner`` is host and port of the server behind. Raises OSError when the port can't be had.
    """

    def __init__(self, port: int, inner: tuple[str, int]) -> None:
        self._inner = inner
        self._open: set[asyncio.StreamWriter] = set()  # all connections
        self._clients = 0  # of these inside
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(
                asyncio.start_server(self._come, LOOPBACK, port, limit=_HEAD)
            )
        except OSError:
            self._loop.close()
            raise
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Show all out, and listen no more."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        for each in self._open:
            each.transport.abort()
        await asyncio.gather(
            *asyncio.all_tasks() - {asyncio.current_task()}, return_exceptions=True
        )

    async def _come(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # What waits in the system's buffer is what a client takes without reading.
        writer.get_extra_info("socket").setsockopt(SOL_SOCKET, SO_SNDBUF, _BUFFER)
        self._open.add(writer)
        try:
            if len(self._open) <= _CONNECTIONS:
                await self._let_in(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # it has gone, says nothing, takes nothing or is no client
        finally:
            self._open.discard(writer)
            writer.close()

    async def _let_in(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_PATIENCE):
            head = await reader.readuntil(b"\r\n\r\n")
        if not _is_welcome(head):
            writer.write(b"HTTP/1.1 403 Forbidden\r\n\r\n")
            return
        if self._clients >= CLIENTS:
            writer.write(b"HTTP/1.1 503 Service Unavailable\r\n\r\n")
            return
        self._clients += 1
        try:
            answers, inside = await asyncio.open_connection(*self._inner)
            inside.write(head)
            ways = {
                asyncio.ensure_future(_pass_on(reader, inside)),
                asyncio.ensure_future(_pass_on(answers, writer)),
            }
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for end in (writer, inside):
                end.transport.abort()
            await asyncio.gather(*ways, return_exceptions=True)
        finally:
            self._clients -= 1


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Until one of them ends, or what is read isn't taken. Raises OSError."""
    while piece := await reader.read(_PIECE):
        writer.write(piece)
        async with asyncio.timeout(_PATIENCE):
            await writer.drain()


def _is_welcome(head: bytes) -> bool:
    """Return whether a request names this machine, and is of no web page but Foxglove's own."""
    lines = head.decode("latin-1").split("\r\n")[1:]
    told = [line.partition(":") for line in lines]
    fields = {name.strip().lower(): value.strip() for name, _, value in told}
    hosts = sum(name.strip().lower() in ("host", "origin") for name, _, _ in told)
    return (
        fields.get("host", "").partition(":")[0] in _HOSTS
        and fields.get("origin", "") in _ORIGINS
        and hosts == len(fields.keys() & {"host", "origin"})  # none twice
    )
