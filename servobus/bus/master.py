"""BusMaster: the asyncio protocol that takes the turns of one line.

The hot path is a callback: `data_received` finishes a turn, resolves its caller and starts the next one, without a
task switch and without a timer of its own. One lazily re-armed deadline timer and one wake timer serve the whole bus.
What is said next is decided by the pure `Runner` and `Scheduler`, what was heard is judged by the pure `Turn`, when
to speak by the pure `Line`; this file joins them to a transport and a clock.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from servobus.engine.engine import Runner
from servobus.engine.line import HALF_AGAIN, QUIET, Line
from servobus.engine.queue import Job
from servobus.engine.turn import Turn, judge
from servobus.errors import LinkDown
from servobus.links.base import Transport
from servobus.protocols.base import Codec, Reply, Request
from servobus.timers import CoarseTimer, FineTimer, clock_of

CLOSE_TIMEOUT = 0.5
"""Seconds for the last bytes to leave."""
SECOND_POLL = 0.001
"""For links that cannot be looked at: one more pass of the loop before a deadline is declared missed."""


class BusMaster(asyncio.Protocol):
    """Owns the line. Callers hand in jobs and hold futures; nothing they do or fail to do tears a turn."""

    def __init__(self, name: str, codec: Codec, runner: Runner, line: Line) -> None:
        self.name = name
        self.runner = runner
        self.line = line
        self.trace: Callable[[bool, bytes, float], None] | None = None
        """Called with (sent, bytes, time) for everything on the wire."""
        self._codec = codec
        self._scheduler = runner.scheduler
        self._health = runner.health
        self._stats = runner.stats
        self._counts = runner.stats.counts
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._transport: Transport | None = None
        self._closed: asyncio.Future[None] = self._loop.create_future()
        self._flight: list[Turn] = []
        """The turns under way, oldest first: one, or on four wires one for each of several nodes."""
        self._deadline = CoarseTimer(self._loop, self._on_deadline)
        self._wake = FineTimer(self._loop, self._on_wake)
        self._pump_due = False

    def __repr__(self) -> str:
        servos = sum(node.configured for node in self._health.nodes.values())
        return f"{self.name}: {servos} servos, {len(self._flight)} in flight, {self._scheduler.waiting()} queued"

    # Callers

    @property
    def up(self) -> bool:
        return self._transport is not None

    def submit(self, job: Job) -> None:
        """Queue a request or a plan. Raises LinkDown, Overloaded."""
        if self._transport is None:
            raise LinkDown("the line is down: it is opened again as soon as the port is there", bus=self.name)
        self._scheduler.submit(job, self._clock())
        if self.runner.idle and (not self._flight or self.line.spread is not None):
            self._pump()

    def submit_stop(self, job: Job, *, estop: bool) -> None:
        """Before all that waits. `estop`: what moves is dropped, and a plan under way is torn. Raises LinkDown."""
        if self._transport is None:
            raise LinkDown("the line is down: nothing can be stopped through it", bus=self.name)
        if estop:
            self._scheduler.drop(self.runner.estopped, motion_only=True)
        (self._scheduler.estop if estop else self._scheduler.stops).append(job)
        self._pump()

    def goals_waiting(self) -> None:
        """Goals were put: they leave after this pass of the loop, together with all others put in it."""
        if not self._pump_due and (not self._flight or self.line.spread is not None):
            self._pump_due = True
            self._loop.call_soon(self._on_wake)

    def set_baudrate(self, baudrate: int) -> None:
        """Between the turns of an exclusive session."""
        if self._transport is not None:
            self._transport.set_baudrate(baudrate)
            self.line.traits = replace(self.line.traits, baudrate=baudrate)
            self.line.listen_out(self._clock())

    async def wait_closed(self) -> None:
        """Until the line is gone."""
        await asyncio.shield(self._closed)

    async def close(self) -> None:
        """Leave the line for good, when what was said has left it; everything that waits ends with LinkDown."""
        transport = self._transport
        if transport is not None:
            transport.close()
            try:
                async with asyncio.timeout(CLOSE_TIMEOUT):
                    await self.wait_closed()
            except TimeoutError:
                transport.abort()
        self._wake.close()

    # The line

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("Transport", transport)
        self._closed = self._loop.create_future()
        self._codec.reset()
        self._health.suspect_all()
        self.line.opened(self._clock())
        self._pump()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        flight, self._flight = self._flight, []
        self._wake.cancel()
        self._health.suspect_all()
        self._counts["line_lost"] += exc is not None
        self.runner.lost(str(exc) if exc else "closed", flight)
        if not self._closed.done():
            self._closed.set_result(None)

    def data_received(self, data: bytes) -> None:
        now = self._clock()
        if self.trace is not None:
            self.trace(False, data, now)
        self._counts["bytes_heard"] += len(data)
        line = self.line
        if line.echo is not None and not (data := line.echo.strip(data)):
            return
        flight = self._flight
        if not flight or (line.traits.paced and self._is_early(len(data), now, flight[0])):
            self._unsolicited(data, now)
            return
        self._codec.receive_data(data)
        strays: list[Reply] = []
        turn = flight[0]
        believed = judge(self._codec, turn, strays, flight[1:])
        if strays:
            self.runner.strays(strays, turn, now)
        if believed:
            self._answered(turn, now)
        elif turn.complete():
            # Something stands behind the answer that is no frame: the answer may be part of something else.
            self._counts["rejected_windows"] += 1
            self._missed(turn, now)

    def _is_early(self, size: int, now: float, turn: Turn) -> bool:
        """Bytes take their time, so the first of these was on the wire before the question had left."""
        least = (min(size, turn.request.reply_size) - 0.5) * self.line.traits.byte_time
        return not (turn.replies or self._codec.pending) and now - least < turn.sent_by

    def _unsolicited(self, data: bytes, now: float) -> None:
        """Nobody asked, or the question has not left yet: never an answer. The line is listened out before the next word."""
        self._counts["unsolicited_bytes"] += len(data)
        self._codec.receive_data(data)
        strays: list[Reply] = []
        while (reply := self._codec.next_reply()) is not None:
            strays.append(reply)
        self.runner.strays(strays, None, now)
        self._codec.reset()  # the rest of them is no beginning of an answer
        if not self._flight:
            self.line.listen_out(now)
            self._pump()  # who spoke is to be asked again, when it is quiet

    # Turns

    def _pump(self) -> None:
        """Say whatever may be said now, and make sure to be woken for what may be said later."""
        while self._transport is not None:
            if self._flight:
                if self.line.spread is None or not self._follow(self._clock()):
                    return
                continue
            now = self._clock()
            ready = self.line.ready_at(now, urgent=self.runner.urgent)
            if ready > now:
                if self.line.babbling:
                    self.runner.babbled()
                self._scheduler.expire(now)
                self._wake.by(ready)
                return
            if self.line.listening_out:
                self._codec.reset()
                self.line.quiet()
            request = self.runner.next_request(now)
            if request is None:
                self._scheduler.expire(now)
                self._wake.by(self._scheduler.wake())
                return
            self._transmit(request, now)

    def _follow(self, now: float) -> bool:
        """On four wires: say the next while the answers to the last are due. False: not now."""
        last = self._flight[-1]
        at = self.line.next_at(last.request.reply_size, now) if last.run is not None else None
        if at is None or at > now:
            self._wake.by(at)
            return False
        request = self.runner.next_request(now, [turn.request.node for turn in self._flight])
        if request is None:
            self._wake.by(self._scheduler.wake())
            return False
        self._transmit(request, now)
        return True

    def _transmit(self, request: Request[Any], now: float) -> None:
        assert self._transport is not None
        line, counts = self.line, self._counts
        frame = request.frame
        start = line.speak(frame, now, 0.0 if request.replies else request.quiet_after)
        counts["frames"] += 1
        counts["bytes_sent"] += len(frame)
        if self.trace is not None:
            self.trace(True, frame, now)
        byte_time = line.traits.byte_time
        if not request.replies:
            self._stats.busy += len(frame) * byte_time
            self._transport.write(frame)
            self.runner.sent(request)
            return
        wire = request.replies * request.reply_size * byte_time
        self._stats.busy += len(frame) * byte_time + wire
        deadline = line.sent_by + wire + self._allowance(request)
        turn = Turn(request, sent_at=start, sent_by=line.sent_by, deadline=deadline)
        if not self._flight:
            self._codec.reset()
        self._flight.append(turn)
        if line.spread is not None:
            self.runner.release(turn)
        self._transport.write(frame)
        self._deadline.by(deadline)

    def _allowance(self, request: Request[Any]) -> float:
        """Seconds beyond the wire time that the answers may take."""
        node = self._health.node
        nodes = request.nodes
        slowest = node(request.node).deadline if len(nodes) < 2 else max(node(each).deadline for each in nodes)
        return slowest + self.line.traits.latency + request.service_time

    def _answered(self, turn: Turn, now: float) -> None:
        self._flight.remove(turn)
        self._counts["turns"] += 1
        self._counts["echoes"] += turn.echoes
        self._stats.turns.add(now - turn.sent_at)
        if not self._flight:
            self.line.answered(now, turn.request.quiet_after)
        self.runner.answered(turn, self._latency(turn, now))
        self._go_on(now)

    def _missed(self, turn: Turn, now: float) -> None:
        self._flight.remove(turn)
        self._counts["timeouts"] += 1
        self._counts["echoes"] += turn.echoes
        self.line.half_until = now + HALF_AGAIN
        self.line.listen_out(now, max(QUIET, turn.request.quiet_after))
        self.runner.missed(turn, now, self._latency(turn, now))
        self._go_on(now)

    def _go_on(self, now: float) -> None:
        """With what came for the next turn while this one was waited for; else with what is to be said."""
        if self._flight and self._flight[0].complete():
            self._answered(self._flight[0], now)
        else:
            self._pump()

    def _latency(self, turn: Turn, now: float) -> float:
        """What the answers took beyond the wire time."""
        return now - turn.sent_by - len(turn.replies) * turn.request.reply_size * self.line.traits.byte_time

    # Time

    def _on_wake(self) -> None:
        self._pump_due = False
        self._pump()

    def _on_deadline(self) -> None:
        """The timer is not moved at each turn, so it may be early for the present one."""
        if not self._flight or self._transport is None:
            return
        turn = self._flight[0]
        if self._clock() >= turn.deadline and not turn.looked:
            # What has arrived and was not read yet is not late.
            turn.looked = True
            if not self._transport.poll_input():
                turn.deadline = self._clock() + SECOND_POLL
        now = self._clock()
        if turn in self._flight and now >= turn.deadline:
            self._missed(turn, now)
        if self._flight:
            self._deadline.by(self._flight[0].deadline)
