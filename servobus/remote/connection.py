"""One connection to a daemon: requests out, answers and notices in, one JSON object a line.

The other end is not trusted: what is no answer ends the connection, a line has a greatest length, and every call a deadline.
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

MAX_ANSWER = 4 * 1024 * 1024
"""Bytes of one line from the daemon."""
MAX_WAITING = 1024
"""Calls of one connection that wait for their answers."""
MAX_UNSENT = 1024 * 1024
"""Bytes that the daemon has not taken yet, above which nothing more is sent."""


class _Message(msgspec.Struct):
    """An answer (id, and result or error) or a notice (method and params)."""

    id: int | None = None
    method: str | None = None
    params: msgspec.Raw = msgspec.Raw()
    result: msgspec.Raw = msgspec.Raw()
    error: Any = None


@dataclass(slots=True)
class _Call:
    method: str
    answer: asyncio.Future[Any]
    timeout: float
    overdue: asyncio.TimerHandle
    then: Callable[[Any], Any] | None
    """Called with the result the moment it comes, before anything that follows it is read; its value is the answer."""


def _plain(value: Any) -> Any:
    """Numbers of other classes (numpy) as JSON's own."""
    for kind in (float, int):
        if isinstance(value, kind):
            return kind(value)
    raise TypeError(f"{type(value).__name__} {value!r:.40} cannot go to the daemon: give plain numbers and strings")


_encode = msgspec.json.Encoder(enc_hook=_plain).encode
_message = msgspec.json.Decoder(_Message).decode


@functools.cache
def _result(method: str) -> Callable[[bytes], Any]:
    return msgspec.json.Decoder(METHODS[method].result).decode


class Connection(asyncio.Protocol):
    """`notice(method, params)` hears what comes unasked; `lost(wire, why)` is called once, when the connection is no more."""

    def __init__(
        self,
        place: str,
        notice: Callable[[str, msgspec.Raw], None],
        lost: Callable[[Connection, LinkDown], None] = lambda *_: None,
    ) -> None:
        self.place = place
        self.down: LinkDown | None = None
        """Why the connection is no more."""
        self.heard = 0.0
        """When the last bytes came."""
        self._notice = notice
        self._lost = lost
        self._loop = asyncio.get_running_loop()
        self._calls: dict[int, _Call] = {}
        self._asked = 0
        self._rest = bytearray()

    # Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self.heard = self._loop.time()

    def data_received(self, data: bytes) -> None:
        self.heard = self._loop.time()
        if b"\n" not in data:
            self._rest += data
        else:
            *lines, rest = (bytes(self._rest) + data).split(b"\n")
            self._rest = bytearray(rest)
            for line in lines:
                if self.down is None:
                    self._line(line)
        if len(self._rest) > MAX_ANSWER:
            self._nonsense(self._rest, f"a line of more than {MAX_ANSWER} bytes")

    def connection_lost(self, error: Exception | None) -> None:
        self.fail("the daemon has closed the connection" if error is None else f"the connection broke: {error}")
        self._lost(self, self.down or LinkDown("closed"))

    # In

    def _line(self, line: bytes) -> None:
        try:
            message = _message(line)
            if message.method is not None:
                self._notice(message.method, message.params)
            elif message.id is None:
                self._rejected(message.error)
            elif not 0 < message.id <= self._asked:
                raise ValueError(f"an answer to request {message.id}, which was never made")
            elif message.id in self._calls:  # else it was given up, or is answered already
                self._answered(message.id, message)
        except (ValueError, KeyError, TypeError, RecursionError) as error:  # msgspec's own are ValueErrors
            self._nonsense(line, str(error))

    def _rejected(self, error: Any) -> None:
        """An error that answers no request of ours is about the connection."""
        if error is None:
            raise ValueError("neither an answer nor a notice")
        self.fail(f"the daemon ends the connection: {decoded(error)}")

    def _answered(self, number: int, message: _Message) -> None:
        call = self._calls[number]
        if message.error is None:
            if not message.result:
                raise ValueError(f"no result for {call.method}")
            value = _result(call.method)(message.result)
            value = call.then(value) if call.then else value
        self._forget(number)
        if call.answer.done():
            return
        if message.error is None:
            call.answer.set_result(value)
        else:
            call.answer.set_exception(decoded(message.error))

    def _nonsense(self, line: bytes | bytearray, why: str) -> None:
        self.fail(f"what answers there is no servobus daemon, or of another version: {why} in {bytes(line[:60])!r}")

    # Out

    async def call(self, method: str, params: dict[str, Any], *, timeout: float, then: Callable[[Any], Any] | None = None) -> Any:
        """What the daemon answers. Raises what it says, LinkDown, and ReplyTimeout when it says nothing for `timeout` seconds."""
        number, answer = self._ask(method, params, timeout, then)
        try:
            return await answer
        finally:
            self._forget(number)

    def _ask(
        self, method: str, params: dict[str, Any], timeout: float, then: Callable[[Any], Any] | None
    ) -> tuple[int, asyncio.Future[Any]]:
        if self.down is not None:
            raise LinkDown(f"{self.down.message}; nothing was sent")
        full = len(self._calls) >= MAX_WAITING or self._transport.get_write_buffer_size() > MAX_UNSENT
        if full and method != "stop":
            raise Overloaded(f"{len(self._calls)} calls wait for the daemon already: ask for less, or later")
        line = self._encoded({"jsonrpc": "2.0", "id": self._asked + 1, "method": method, "params": params})
        self._asked = number = self._asked + 1
        answer = self._loop.create_future()
        self._calls[number] = _Call(method, answer, timeout, self._loop.call_later(timeout, self._overdue, number), then)
        self._transport.write(line)
        return number, answer

    def tell(self, method: str, params: dict[str, Any]) -> None:
        """Without an answer."""
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

    # Ends

    def still(self, method: str) -> None:
        """The daemon is at it: those calls get their full time again."""
        for number, call in self._calls.items():
            if call.method == method:
                call.overdue.cancel()
                call.overdue = self._loop.call_later(call.timeout, self._overdue, number)

    def _overdue(self, number: int) -> None:
        call = self._calls[number]
        if not call.answer.done():
            call.answer.set_exception(
                ReplyTimeout(f"the daemon did not answer {call.method} within {call.timeout:g} s: it may have been applied")
            )

    def _forget(self, number: int) -> None:
        call = self._calls.pop(number, None)
        if call is not None:
            call.overdue.cancel()

    def fail(self, why: str) -> None:
        """Give the connection up at once."""
        if self.down is not None:
            return
        self.down = LinkDown(f"{self.place}: {why}")
        for call in self._calls.values():
            if not call.answer.done():
                call.answer.set_exception(LinkDown(f"{self.down.message}; {call.method} was under way and may have been applied"))
        self._transport.abort()

    def close(self) -> None:
        """Once what was said has gone out."""
        if self.down is None:
            self.down = LinkDown(f"{self.place}: this client has left")
            self._transport.close()
