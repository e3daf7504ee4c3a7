"""One client of the native door: an asyncio protocol.

A call of `stop`, or `renew`, is looked for in whatever has come, and done before anything else. The other lines wait for their
share of the loop, in turn with those of all other clients. A client that says more than its rate is read more slowly; one that
does not read what it is told is not told more, and left when that lasts.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable
from types import CoroutineType
from typing import TYPE_CHECKING, Any, cast

from servobus.config.access import Role
from servobus.daemon.fairness import TokenBucket
from servobus.daemon.jsonrpc import (
    URGENT,
    Call,
    Framer,
    Refused,
    answered,
    call_of,
    encode,
    failure,
    notification,
    parse,
    urgent,
)
from servobus.daemon.methods import VERBS, require
from servobus.errors import ServobusError
from servobus.rig.logs import EventLogger
from servobus.rpc.methods import Hello

if TYPE_CHECKING:
    from servobus.daemon.server import NativeDoor

MAX_WAITING = 256 * 1024
"""Bytes of one client that may wait; then it is not read until they are fewer. Well above what our own client lets wait, so that
its `stop` is always read."""
MAX_TASKS = 256
"""Calls of one client under way at once, above which only the urgent ones begin."""
MAX_UNREAD = 256 * 1024
"""Bytes that a client may be behind with its reading."""
PATIENCE = 10.0
"""Seconds after which one that reads nothing is left."""
OVERHEAD = 64
"""Bytes that a line takes besides what it says."""
LABEL = 64

log = EventLogger("servobus.daemon")


def printable(name: str) -> str:
    """As others may be shown it."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:LABEL])


class Connection(asyncio.Protocol):
    """`role` and `who` are the listener's to say; on TCP they come with the token."""

    def __init__(self, door: NativeDoor, *, tcp: bool = False) -> None:
        self.door: NativeDoor = door
        self.role = Role.NOBODY
        self.blocked = False
        """It does not read: nothing more is written than what it waits for."""
        self.who = ""
        self._name = ""
        self._tcp = tcp
        self._framer = Framer()
        self._lines: deque[bytes] = deque()
        self._waiting = 0
        """Bytes that they take."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._working = False
        self._resting = False
        self._closed = False
        self._over = False
        """It says nothing more."""
        self._timer: asyncio.TimerHandle | None = None
        self._transport: asyncio.Transport

    @property
    def label(self) -> str:
        """Who holds a lease, for others."""
        return f"{self._name} ({self.who})" if self._name else self.who

    def greet(self, params: Hello) -> None:
        """Raises AccessDenied for a token that is not the right one."""
        if self._tcp and self.role is Role.NOBODY:
            self.role = self.door.admit(self, params.token)
        self._name = printable(params.client)

    # The socket

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=MAX_UNREAD)
        refusal = self.door.enter(self, transport.get_extra_info("socket"), tcp=self._tcp)
        if refusal is not None:
            self._transport.write(failure(None, refusal) + b"\n")
            self._transport.close()
            return
        self._bucket = TokenBucket(self.door.options.rate, self.door.now())

    def connection_lost(self, exc: Exception | None) -> None:
        self._closed = True
        self._lines.clear()
        self._stop_timer()
        self.door.leave(self)
        for task in self._tasks:
            task.cancel()

    def pause_writing(self) -> None:
        self.blocked = True
        self._stop_timer()
        self._timer = self.door.loop.call_later(PATIENCE, self._transport.abort)

    def resume_writing(self) -> None:
        self.blocked = False
        self._stop_timer()
        self._work()

    def eof_received(self) -> bool:
        """What it asked before it ended is answered first: `nc` ends so."""
        self._over = True
        if not (self._lines or self._tasks):
            return False
        self.door.loop.call_later(PATIENCE, self._transport.close)
        return True

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def data_received(self, data: bytes) -> None:
        try:
            lines = self._framer.feed(data)
        except Refused as refusal:
            self.write(refusal.answer() + b"\n")
            self._transport.close()
            return
        ahead = set(URGENT)  # of each, one in what came together: a flood of them waits as any other
        for line in lines:
            found = urgent(line) & ahead
            if found:
                ahead -= found
                self._do(line)
            elif line.strip():
                self._lines.append(line)
                self._waiting += len(line) + OVERHEAD
        if self._waiting > MAX_WAITING and not self._resting:
            self._resting = True
            self._transport.pause_reading()
        self._work()

    # Its share of the loop

    def _work(self) -> None:
        if self._lines and not (self._working or self._closed or self.blocked or len(self._tasks) >= MAX_TASKS):
            self._working = True
            more = True
            while more and self.door.work.at_once():  # goals that came together leave together
                more = self._turn()
            if more:
                self.door.work.add(self._turn)

    def _turn(self) -> bool:
        """One line; whether there is another to be done at once."""
        if self._closed or not self._lines:
            self._working = False
            return False
        line = self._lines.popleft()
        self._waiting -= len(line) + OVERHEAD
        self._do(line)
        if self._resting and self._waiting <= MAX_WAITING // 2 and not self._closed:
            self._resting = False
            self._transport.resume_reading()
        wait = self._bucket.take(self.door.now())
        if wait:
            self.door.loop.call_later(wait, self._go_on)  # it stays `working`: nothing else begins its next turn
            return False
        self._working = bool(self._lines) and not (self.blocked or len(self._tasks) >= MAX_TASKS)
        self._leave_if_done()
        return self._working

    def _go_on(self) -> None:
        self._working = False
        self._work()

    def _do(self, line: bytes) -> None:
        try:
            messages = parse(line)
        except Refused as refusal:
            self.write(refusal.answer() + b"\n")
            return
        calls: list[Call | Refused] = []
        for message in messages:
            try:
                calls.append(call_of(message))
            except Refused as refusal:
                calls.append(refusal)
        if line.lstrip().startswith(b"["):
            self._spawn(self._batch(calls))
            return
        (call,) = calls
        if isinstance(call, Refused):
            self.write(call.answer() + b"\n")
            return
        result = self._begin(call)
        if isinstance(result, CoroutineType):
            self._spawn(self._finish(call, result))
        elif call.wants_answer:
            self.write(self._told(call, result) + b"\n")

    def _begin(self, call: Call) -> Any:
        """The result, its error, or what to await for them."""
        try:
            require(self, call.method, call.params)
            return VERBS[call.method](self, call.params)
        except Exception as error:  # noqa: BLE001 - whatever it is, its caller is told
            return error

    def _told(self, call: Call, result: Any) -> bytes:
        if isinstance(result, BaseException):
            if not isinstance(result, (ServobusError, ValueError, TypeError)):
                log.error("door_mistake", method=call.method, error=repr(result))
            return failure(call.id, result)
        return answered(call.id, result)

    async def _batch(self, calls: list[Call | Refused]) -> None:
        """One after the other, what is urgent first; the answers leave together, in the order of the calls."""
        answers: dict[int, bytes] = {}
        for at in sorted(range(len(calls)), key=lambda at: getattr(calls[at], "method", "") not in URGENT):
            call = calls[at]
            if isinstance(call, Refused):
                answers[at] = call.answer()
                continue
            told = await self._ended(self._begin(call))
            if call.wants_answer:
                answers[at] = self._told(call, told)
        if answers:
            self.write(b"[%b]\n" % b",".join(answers[at] for at in sorted(answers)))

    async def _finish(self, call: Call, result: Awaitable[Any]) -> None:
        told = await self._ended(result)
        if call.wants_answer:
            self.write(self._told(call, told) + b"\n")

    @staticmethod
    async def _ended(result: Any) -> Any:
        if not isinstance(result, CoroutineType):
            return result
        try:
            return await result
        except Exception as error:  # noqa: BLE001 - whatever it is, its caller is told
            return error

    def _spawn(self, work: Any) -> None:
        task = self.door.loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._work()
        self._leave_if_done()

    def _leave_if_done(self) -> None:
        if self._over and not (self._lines or self._tasks or self._closed):
            self._transport.close()

    # What it is told

    def write(self, data: bytes) -> None:
        if not self._closed:
            self._transport.write(data)

    def notify(self, method: str, params: Any) -> None:
        """Only as far as it reads."""
        if not self.blocked:
            self.write(notification(method, encode(params)))

    def close(self) -> None:
        self._transport.close()

    def abort(self) -> None:
        self._transport.abort()
