"""One connection to a daemon: calls out, replies and notices in, one JSON object a line.

The other end is not trusted: a line that is neither reply nor notice ends the connection, lines have a maximum length, and every
call has a deadline.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import msgspec

from servobus.errors import InvalidRequest, LimitError, LinkDown, Overloaded, ReplyTimeout
from servobus.rpc.errors import decoded
from servobus.rpc.methods import MAX_LINE, METHODS
from servobus.values import Role

MAX_REPLY = 4 * 1024 * 1024  # bytes of one line from the daemon
MAX_WAITING = 1024  # calls of one connection that wait for their replies
MAX_UNSENT = 1024 * 1024  # bytes that the daemon has not taken yet, above which nothing more is sent


class _Message(msgspec.Struct):
    """A reply (id, and result or error) or a notice (method and params)."""

    id: int | None = None
    method: str | None = None
    params: msgspec.Raw = msgspec.Raw()
    result: msgspec.Raw = msgspec.Raw()
    error: Any = None


@dataclass(slots=True)
class _PendingCall:
    method: str
    reply: asyncio.Future[Any]
    timeout: float
    overdue: asyncio.TimerHandle
    then: Callable[[Any], Any] | None
    """Called with the result the moment it comes, before anything that follows it is read; its value is the reply."""


def _changes(method: str) -> bool:
    """Return whether a call of this method asks for a change."""
    return METHODS[method].role > Role.OBSERVER or method == "stop"


def _plain(value: Any) -> Any:
    """Numbers of other classes (numpy) as plain ones."""
    for kind in (float, int):
        if isinstance(value, kind):
            return kind(value)
    raise TypeError(f"{type(value).__name__} {value!r:.40} cannot go to the daemon: give plain numbers and strings")


_encode = msgspec.json.Encoder(enc_hook=_plain).encode
_message = msgspec.json.Decoder(_Message).decode


@functools.cache
def _result(method: str) -> Callable[[bytes], Any]:
    return msgspec.json.Decoder(METHODS[method].result).decode


class DaemonConnection(asyncio.Protocol):
    """`notice(method, params)` is called with each notice, `lost(connection, error)` once, when the connection has ended."""

    def __init__(
        self,
        address: str,
        notice: Callable[[str, msgspec.Raw], None],
        lost: Callable[[DaemonConnection, LinkDown], None] = lambda *_: None,
    ) -> None:
        self.address = address
        self.down: LinkDown | None = None  # why the connection has ended
        self.received_at = 0.0  # loop time of the last bytes
        self._notice = notice
        self._lost = lost
        self._loop = asyncio.get_running_loop()
        self._calls: dict[int, _PendingCall] = {}
        self._last_id = 0
        self._rest = bytearray()

    # Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self.received_at = self._loop.time()

    def data_received(self, data: bytes) -> None:
        self.received_at = self._loop.time()
        if b"\n" not in data:
            self._rest += data
        else:
            *lines, rest = (bytes(self._rest) + data).split(b"\n")
            self._rest = bytearray(rest)
            for line in lines:
                if self.down is None:
                    self._line(line)
        if len(self._rest) > MAX_REPLY:
            self._reject(self._rest, f"a line of more than {MAX_REPLY} bytes")

    def connection_lost(self, error: Exception | None) -> None:
        self.fail("the daemon has closed the connection" if error is None else f"the connection broke: {error}")
        self._lost(self, self.down or LinkDown("closed"))

    # Lines from the daemon

    def _line(self, line: bytes) -> None:
        try:
            message = _message(line)
            if message.method is not None:
                self._notice(message.method, message.params)
            elif message.id is None and message.error is not None:  # an error without a call is about the connection
                self.fail(f"the daemon ends the connection: {decoded(message.error)}")
            elif message.id is None:
                raise ValueError("neither a reply nor a notice")
            elif not 0 < message.id <= self._last_id:
                raise ValueError(f"a reply to call {message.id}, which was never made")
            elif message.id in self._calls:  # else its caller has left
                self._finish(message.id, message)
        except (ValueError, KeyError, TypeError, RecursionError) as error:  # msgspec's own are ValueErrors
            self._reject(line, str(error))

    def _finish(self, number: int, message: _Message) -> None:
        call = self._calls[number]
        if message.error is None:
            if not message.result:
                raise ValueError(f"no result for {call.method}")
            value = _result(call.method)(message.result)
            value = call.then(value) if call.then else value
        self._forget(number)
        if call.reply.done():
            return
        if message.error is None:
            call.reply.set_result(value)
        else:
            call.reply.set_exception(decoded(message.error))

    def _reject(self, line: bytes | bytearray, why: str) -> None:
        self.fail(f"what answers there is no servobus daemon, or of another version: {why} in {bytes(line[:60])!r}")

    # Calls

    async def call(self, method: str, params: dict[str, Any], *, timeout: float, then: Callable[[Any], Any] | None = None) -> Any:
        """Call a method and return its result. A caller that is cancelled, or gives up, withdraws its call.

        Raises the error of the reply, LinkDown; ReplyTimeout after `timeout` seconds.
        """
        if self.down is not None:
            raise LinkDown(f"{self.down.message}; nothing was sent")
        full = len(self._calls) >= MAX_WAITING or self._transport.get_write_buffer_size() > MAX_UNSENT
        if full and method != "stop":
            raise Overloaded(f"{len(self._calls)} calls wait for the daemon already: ask for less, or later")
        line = self._encoded({"jsonrpc": "2.0", "id": self._last_id + 1, "method": method, "params": params})
        self._last_id = number = self._last_id + 1
        reply = self._loop.create_future()
        self._calls[number] = _PendingCall(method, reply, timeout, self._loop.call_later(timeout, self._overdue, number), then)
        self._transport.write(line)
        try:
            return await reply
        except asyncio.CancelledError:
            self.notify("cancel", {"call": number})
            raise
        finally:
            self._forget(number)

    def notify(self, method: str, params: dict[str, Any]) -> None:
        """Call a method without waiting for a reply."""
        if self.down is None:
            self._transport.write(self._encoded({"jsonrpc": "2.0", "method": method, "params": params}))

    @staticmethod
    def _encoded(message: dict[str, Any]) -> bytes:
        try:
            line = _encode(message) + b"\n"
        except OverflowError as error:
            raise LimitError(f"a number is too large: {error}; nothing was sent") from None
        if len(line) > MAX_LINE:
            raise InvalidRequest(f"this call is {len(line)} bytes long, the daemon takes {MAX_LINE}: split it; nothing was sent")
        return line

    # Time-outs and the end

    def extend(self, method: str) -> None:
        """The daemon is working on calls of this method: their time-out begins again."""
        for number, call in self._calls.items():
            if call.method == method:
                call.overdue.cancel()
                call.overdue = self._loop.call_later(call.timeout, self._overdue, number)

    def _overdue(self, number: int) -> None:
        call = self._calls[number]
        if not call.reply.done():
            applied = ": it may have been applied" if _changes(call.method) else ""
            message = f"the daemon did not answer {call.method} within {call.timeout:g} s{applied}"
            call.reply.set_exception(ReplyTimeout(message))
            self.notify("cancel", {"call": number})  # what has not begun yet must not begin later

    def _forget(self, number: int) -> None:
        call = self._calls.pop(number, None)
        if call is not None:
            call.overdue.cancel()

    def fail(self, why: str) -> None:
        """End the connection at once; what waits fails."""
        if self.down is not None:
            return
        self.down = LinkDown(f"{self.address}: {why}")
        for call in self._calls.values():
            if not call.reply.done():
                applied = " and may have been applied" if _changes(call.method) else ""
                call.reply.set_exception(LinkDown(f"{self.down.message}; {call.method} was under way{applied}"))
        self._transport.abort()

    def close(self) -> None:
        """End the connection once everything is sent."""
        if self.down is None:
            self.down = LinkDown(f"{self.address}: this client has left")
            self._transport.close()
