"""The client's end of a connection to a daemon: calls by number, notifications as they come."""

from __future__ import annotations

import asyncio
import itertools
import socket
import ssl
from collections.abc import Callable, Mapping
from typing import Any, cast
from urllib.parse import urlsplit

import msgspec

from servobus.errors import ConfigError, LinkDown
from servobus.rpc.errors import decoded
from servobus.rpc.methods import MAX_LINE

CONNECT_TIMEOUT = 3.0
MOST = 64 * MAX_LINE
"""Bytes of one line that a client takes: the states of a large rig are longer than any request."""
START = "start it: servobus run CONFIG"

_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder().decode


class Wire(asyncio.Protocol):
    """Every call ends: with its answer, its error, or LinkDown."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.closed: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        """Why it is closed."""
        self.on_notification: Callable[[str, Any], None] = lambda method, params: None
        self._numbers = itertools.count(1)
        self._calls: dict[int, asyncio.Future[Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0
        self._transport: asyncio.Transport
        self._reason = "the daemon closed the connection"

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def connection_lost(self, exc: Exception | None) -> None:
        reason = f"{self._reason} ({exc})" if exc else self._reason
        if not self.closed.done():
            self.closed.set_result(reason)
        calls, self._calls = self._calls, {}
        for future in calls.values():
            if not future.done():
                future.set_exception(LinkDown(f"{reason} while this was under way: it may have been applied"))

    def data_received(self, data: bytes) -> None:
        *lines, rest = data.split(b"\n")
        for line in lines:
            whole, self._parts, self._size = b"".join([*self._parts, line]), [], 0
            if whole and not self._heard(whole):
                return
        if rest:
            self._parts.append(rest)
            self._size += len(rest)
            if self._size > MOST:
                self._give_up("what it says has no end: is that a servobus daemon?")

    def _heard(self, line: bytes) -> bool:
        try:
            message = _decode(line)
            if "method" in message:
                self.on_notification(message["method"], message["params"])
            else:
                self._answered(message)
        except Exception as error:  # noqa: BLE001 - whatever it is, who says it is not understood
            self._give_up(
                f"what it says cannot be understood ({type(error).__name__}): is that a servobus daemon of this version?"
            )
            return False
        return True

    def _answered(self, message: Any) -> None:
        error = message.get("error")
        if message["id"] is None and error is not None:  # of no call: why it shuts us out
            self._give_up(str(decoded(error)))
            return
        future = self._calls.pop(message["id"], None)
        if future is None or future.done():
            return  # given up, or said twice
        if error is not None:
            future.set_exception(decoded(error))
        else:
            future.set_result(message["result"])

    def _give_up(self, reason: str) -> None:
        self._reason = reason
        self._transport.abort()

    async def call(self, method: str, params: Mapping[str, Any], patience: float) -> Any:
        """The result. Raises what the daemon says, LinkDown, or LinkDown when it says nothing for so many seconds."""
        if self.closed.done():
            raise LinkDown(f"{self.closed.result()}: nothing was sent")
        number = next(self._numbers)
        future = self._calls[number] = asyncio.get_running_loop().create_future()
        self._transport.write(_encode({"jsonrpc": "2.0", "id": number, "method": method, "params": params}) + b"\n")
        try:
            async with asyncio.timeout(patience):
                return await future
        except TimeoutError:
            raise LinkDown(f"{self.address} did not answer {method} within {patience:g} s: it may have been applied") from None
        finally:
            self._calls.pop(number, None)

    def tell(self, method: str, params: Mapping[str, Any]) -> None:
        """Without waiting for anything."""
        self._transport.write(_encode({"jsonrpc": "2.0", "method": method, "params": params}) + b"\n")

    def close(self) -> None:
        self._reason = "it was closed here"
        self._transport.close()

    async def wait_closed(self) -> None:
        self.close()
        await asyncio.wait([self.closed], timeout=CONNECT_TIMEOUT)


async def open_wire(address: str, tls: ssl.SSLContext | None = None) -> Wire:
    """To a socket's path, or tcp://host:port. Raises LinkDown, ConfigError."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            if not address.startswith("tcp://"):
                return (await loop.create_unix_connection(lambda: Wire(address), address))[1]
            host, port = _place(address)
            _, wire = await loop.create_connection(lambda: Wire(address), host, port, ssl=tls)
            return wire
    except FileNotFoundError:
        raise LinkDown(f"no daemon runs here, there is no {address}: {START}") from None
    except (ConnectionRefusedError, TimeoutError):
        raise LinkDown(f"no daemon listens at {address}: {START}") from None
    except PermissionError:
        raise LinkDown(f"{address} may not be opened by this user: join the group servobus, or ask who runs the daemon") from None
    except (OSError, socket.gaierror) as error:
        raise LinkDown(f"{address} cannot be reached ({error}): check the address") from None


def _place(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or parts.path or parts.query:
        raise ConfigError(f"{address!r} cannot be read: write tcp://HOST:PORT, or the path of a socket")
    return host, port
