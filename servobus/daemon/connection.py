"""One client of the daemon: an asyncio protocol.

Received lines are searched for calls of `stop`, `renew` and `cancel`, which are done before anything else. The other lines wait
for their share of the loop, in turn with those of all other clients. A client that sends above its rate is read more slowly. A
client that does not read gets no more notices, and is disconnected when that lasts.
"""

from __future__ import annotations

import asyncio
import select
import socket
from collections import deque
from collections.abc import Awaitable, Coroutine
from types import CoroutineType
from typing import Any, Protocol, cast

from servobus.config.access import DoorOptions, Role
from servobus.daemon.fairness import FairShare, TokenBucket
from servobus.daemon.jsonrpc import URGENT, Call, Framer, Refused, call_of, encode, failure, notification, parse, success, urgent
from servobus.daemon.methods import HANDLERS, Services, require_role
from servobus.daemon.standstill import StandStill
from servobus.errors import ServobusError
from servobus.rig.logs import EventLogger
from servobus.rpc.clock import CallerClock
from servobus.rpc.methods import Hello
from servobus.timers import clock_of

MAX_WAITING = 256 * 1024
"""Bytes of one client that may wait; above it the client is not read. More than our own client lets wait, so that its `stop` is
always read."""
MAX_TASKS = 256  # calls of one client under way at once; above it only urgent ones begin
MAX_UNREAD = 256 * 1024  # bytes that a client may be behind with reading
MAX_BLOCKED = 10.0  # seconds after which a client that reads nothing is disconnected
OVERHEAD = 64  # bytes that a waiting line takes besides its text
MAX_LABEL = 64  # letters of a client's name
URGENT_CALLS = {"stop": 1, "renew": 1, "cancel": 64}
"""How many calls of each urgent method go ahead of what came with them; a flood of them waits like any other call."""

log = EventLogger("servobus.daemon")


def printable(name: str) -> str:
    """The name of a client as other clients may see it."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:MAX_LABEL])


class Door(Protocol):
    """What a connection needs of the door that it came through."""

    loop: asyncio.AbstractEventLoop
    options: DoorOptions
    services: Services
    share: FairShare
    stand_still: StandStill

    def now(self) -> float: ...

    def enter(self, client: ClientConnection, sock: socket.socket, *, tcp: bool) -> ServobusError | None: ...

    def admit(self, client: ClientConnection, token: str | None) -> Role: ...

    def leave(self, client: ClientConnection) -> None: ...


class ClientConnection(asyncio.Protocol):
    """`role` and `who` are set by the door; on TCP the role comes with the token."""

    def __init__(self, door: Door, *, tcp: bool = False) -> None:
        self.door = door
        self.role = Role.NOBODY
        self.blocked = False  # the client does not read: only replies to its calls are written
        self.who = ""
        self._name = ""
        self._tcp = tcp
        self._framer = Framer()
        self._lines: deque[tuple[bytes, float]] = deque()  # each with the moment since which it may have waited
        self._waiting = 0  # bytes that they take
        self._since: float | None = None  # that moment of the line whose call begins now
        self._tasks: dict[asyncio.Task[None], Any] = {}  # each with the id of its call; None: it has none
        self._withdrawn: set[Any] = set()  # ids of calls that were cancelled while they waited
        self._now = clock_of(door.loop)
        self._clock = CallerClock()
        self._paused_at: float | None = None  # since when the socket is not read
        self._scheduled = False  # a next line will be handled without further ado
        self._paused = False  # the socket is not read
        self._closed = False
        self._at_eof = False  # the client sends nothing more
        self._timer: asyncio.TimerHandle | None = None
        self._transport: asyncio.Transport

    @property
    def label(self) -> str:
        """The holder of a lease, as other clients see it."""
        return f"{self._name} ({self.who})" if self._name else self.who

    def greet(self, params: Hello) -> None:
        """Take its name and token. Raises AccessDenied for a wrong token."""
        if self._tcp and self.role is Role.NOBODY:
            self.role = self.door.admit(self, params.token)
        self._name = printable(params.client)
        self._clock.greet(params.machine)
        self.age(params.asked)

    def age(self, asked: float | None) -> float:
        """Return the seconds since a call was made at `asked` of the client's clock; None: since it may have been made."""
        if asked is not None:
            return self._clock.age(asked, self._now())
        return 0.0 if self._since is None else self._now() - self._since

    def has_left(self) -> bool:
        """Return whether the client has closed its connection, which is noticed only when all it sent is read."""
        poll = select.poll()
        poll.register(self._transport.get_extra_info("socket").fileno(), 0)
        return any(event & (select.POLLHUP | select.POLLERR) for _, event in poll.poll(0))

    def cancel(self, call: Any) -> None:
        """Withdraw a call of this connection: one that waits does not begin, one that is under way is cancelled."""
        tasks = [task for task, number in self._tasks.items() if number == call]
        for task in tasks:
            task.cancel()
        if not tasks and self._lines:
            self._withdrawn.add(call)

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
        for task in tuple(self._tasks):
            task.cancel()

    def pause_writing(self) -> None:
        self.blocked = True
        self._stop_timer()
        self._timer = self.door.loop.call_later(MAX_BLOCKED, self._transport.abort)

    def resume_writing(self) -> None:
        self.blocked = False
        self._stop_timer()
        self._handle_lines()

    def eof_received(self) -> bool:
        """Answer first what the client asked before it closed its side (`nc` does so)."""
        self._at_eof = True
        if not (self._lines or self._tasks):
            return False
        self.door.loop.call_later(MAX_BLOCKED, self._transport.close)
        return True

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def data_received(self, data: bytes) -> None:
        try:
            lines = self._framer.feed(data)
        except Refused as refusal:
            self.write(refusal.reply() + b"\n")
            self._transport.close()
            return
        since = self.door.stand_still.earliest()
        if self._paused_at is not None:
            since, self._paused_at = min(since, self._paused_at), None
        ahead = []
        allowed = dict(URGENT_CALLS)
        for line in lines:
            methods = urgent(line)
            if methods and all(allowed[method] for method in methods):
                for method in methods:
                    allowed[method] -= 1
                ahead.append(line)
            elif line.strip():
                self._lines.append((line, since))
                self._waiting += len(line) + OVERHEAD
        for line in ahead:
            self._do(line, since)
        if self._waiting > MAX_WAITING and not self._paused:
            self._paused = True
            self._paused_at = self._now()
            self._transport.pause_reading()
        self._handle_lines()

    # Its share of the loop

    def _handle_lines(self) -> None:
        if self._lines and not (self._scheduled or self._closed or self.blocked or len(self._tasks) >= MAX_TASKS):
            self._scheduled = True
            more = True
            while more and self.door.share.at_once():  # goals that came together leave together
                more = self._next_line()
            if more:
                self.door.share.add(self._next_line)

    def _next_line(self) -> bool:
        """Handle one line. Returns whether another one may be handled at once."""
        if self._closed or not self._lines:
            self._scheduled = False
            self._withdrawn.clear()
            return False
        line, since = self._lines.popleft()
        self._waiting -= len(line) + OVERHEAD
        self._do(line, since)
        if self._paused and self._waiting <= MAX_WAITING // 2 and not self._closed:
            self._paused = False
            self._transport.resume_reading()
        if wait := self._bucket.take(self.door.now()):
            self.door.loop.call_later(wait, self._go_on)  # it stays scheduled, so that nothing else handles its next line
            return False
        self._scheduled = bool(self._lines) and not (self.blocked or len(self._tasks) >= MAX_TASKS)
        self._leave_if_done()
        return self._scheduled

    def _go_on(self) -> None:
        self._scheduled = False
        self._handle_lines()

    def _do(self, line: bytes, since: float) -> None:
        try:
            messages = parse(line)
        except Refused as refusal:
            self.write(refusal.reply() + b"\n")
            return
        calls: list[Call | Refused] = []
        for message in messages:
            try:
                calls.append(call_of(message))
            except Refused as refusal:
                calls.append(refusal)
        if line.lstrip().startswith(b"["):
            self._spawn(self._batch(calls), None)
            return
        (call,) = calls
        if isinstance(call, Refused):
            self.write(call.reply() + b"\n")
            return
        if call.id in self._withdrawn:
            self._withdrawn.discard(call.id)
            return  # nobody waits for its reply
        self._since = since
        result = self._begin(call)
        self._since = None
        if isinstance(result, CoroutineType):
            self._spawn(self._finish(call, result), call.id if call.wants_reply else None)
        elif call.wants_reply:
            self.write(self._reply(call, result) + b"\n")

    def _begin(self, call: Call) -> Any:
        """The result, an error, or a coroutine to await for them."""
        try:
            require_role(self, call.method, call.params)
            return HANDLERS[call.method](self.door.services, self, call.params)
        except Exception as error:  # noqa: BLE001 - whatever it is, it becomes the reply
            return error

    def _reply(self, call: Call, result: Any) -> bytes:
        if isinstance(result, BaseException):
            if not isinstance(result, (ServobusError, ValueError, TypeError)):
                log.error("internal_error", method=call.method, error=repr(result))
            return failure(call.id, result)
        return success(call.id, result)

    async def _batch(self, calls: list[Call | Refused]) -> None:
        """Do the calls one after the other, urgent ones first. The replies leave together, in the order of the calls."""
        replies: dict[int, bytes] = {}
        for at in sorted(range(len(calls)), key=lambda at: getattr(calls[at], "method", "") not in URGENT):
            call = calls[at]
            if isinstance(call, Refused):
                replies[at] = call.reply()
                continue
            result = await self._ended(self._begin(call))
            if call.wants_reply:
                replies[at] = self._reply(call, result)
        if replies:
            self.write(b"[%b]\n" % b",".join(replies[at] for at in sorted(replies)))

    async def _finish(self, call: Call, result: Awaitable[Any]) -> None:
        value = await self._ended(result)
        if call.wants_reply:
            self.write(self._reply(call, value) + b"\n")

    @staticmethod
    async def _ended(result: Any) -> Any:
        if not isinstance(result, CoroutineType):
            return result
        try:
            return await result
        except Exception as error:  # noqa: BLE001 - whatever it is, it becomes the reply
            return error

    def _spawn(self, coroutine: Coroutine[Any, Any, None], call: Any) -> None:
        task = self.door.loop.create_task(coroutine)
        self._tasks[task] = call
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.pop(task, None)
        self._handle_lines()
        self._leave_if_done()

    def _leave_if_done(self) -> None:
        if self._at_eof and not (self._lines or self._tasks or self._closed):
            self._transport.close()

    # Out

    def write(self, data: bytes) -> None:
        if not self._closed:
            self._transport.write(data)

    def notify(self, method: str, params: Any) -> None:
        """Send a notice, unless the client does not read."""
        if not self.blocked:
            self.write(notification(method, encode(params)))

    def close(self) -> None:
        self._transport.close()

    def abort(self) -> None:
        self._transport.abort()
