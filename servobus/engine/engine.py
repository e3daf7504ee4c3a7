"""The engine of one line: bytes and times go in, frames and deadlines come out. Pure: no asyncio, no clock, no port.

Whoever runs it reports what happens (`opened`, `receive`, `timed_out`, `lost`, `submit`) and then asks `next_action(now)`
until that is not a `Transmit` any more. Half duplex: one turn at a time. A plan keeps the line from its first frame to
its last; only an e-stop comes between.

Before each frame the engine goes through these cases:

1. A turn is under way: nothing is transmitted before its replies are here or its deadline has passed.
2. The line must be silent for a while (it was opened, a reply is missing, bytes came unasked): wait. Only an e-stop is
   transmitted on a line that never falls silent; any plan under way fails then.
3. The job that has the line gives its next request, or a fence before it: see `runner.py`. The request is transmitted;
   with no reply due, its value is there at once.

How a turn ends:

1. Every reply was believed: the request has its value, or the error that the reply tells.
2. Some replies of a group read are missing: those that came count, the silent nodes become doubtful.
3. A reply is missing, or the window was rejected: the silent nodes become doubtful, and the line must fall silent. The
   runner sends the request once more, or gives it up.
4. The line was lost: everything ends with LinkDown.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final, NamedTuple, TypeAlias

from servobus.engine.job import Job, JobKind
from servobus.engine.line import QUIET, Line
from servobus.engine.runner import JobRunner
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats, Cause, Counter
from servobus.engine.turn import Transmit, Turn, Window, judge
from servobus.errors import LinkDown, ReplyTimeout
from servobus.protocols.base import Codec, Reply, Request

# Looking a member up in its enum is a Python call, and these are needed in every turn.
FRAMES, TURNS, ECHOES = Counter.FRAMES, Counter.TURNS, Counter.ECHOES
BYTES_SENT, BYTES_RECEIVED = Counter.BYTES_SENT, Counter.BYTES_RECEIVED
WINDOW_OPEN, BELIEVED, ESTOP = Window.OPEN, Window.BELIEVED, JobKind.ESTOP


class WaitUntil(NamedTuple):
    """Nothing is transmitted before this time, unless something happens first."""

    when: float


class Idle:
    """Nothing is to be done before something happens."""


FOLD_MASK = 1023
"""The histogram of the turns is folded whenever their number has these bits clear."""
IDLE: Final = Idle()
Action: TypeAlias = Transmit | WaitUntil | Idle


class Engine:
    """One half-duplex line: its turns, jobs, timing and the health of its nodes."""

    def __init__(self, bus: str, codec: Codec, scheduler: Scheduler, line: Line, stats: BusStats) -> None:
        self.bus = bus
        self.scheduler = scheduler
        self.nodes = scheduler.nodes
        self.line = line
        self.stats = stats
        self.up = False
        """The line is open."""
        self._codec = codec
        self.runner = JobRunner(bus, scheduler, scheduler.nodes, stats)
        self._turn: Turn | None = None
        """The oldest turn under way."""
        self._ended: Turn | None = None
        """A turn of a plain job whose value was not delivered yet: the next frame goes first."""
        self._unanswered: Job | None = None
        """The job of a frame to which no reply is due, and which is being handed over now."""
        self._buffering = False
        """The codec was given bytes since it was reset."""
        self._skipped_before = 0
        """What the codec had skipped when it was reset."""
        self._foreign: tuple[Turn, Cause] | None = None
        """A turn in which a stray arrived, and what that tells about it."""

    def __repr__(self) -> str:
        servos = sum(node.configured for node in self.nodes.by_id.values())
        return f"{self.bus}: {servos} nodes, {self.in_flight} in flight, {self.scheduler.waiting()} queued"

    @property
    def in_flight(self) -> int:
        """Turns under way."""
        return 0 if self._turn is None else 1

    @property
    def idle(self) -> bool:
        """No job is under way and no turn is in flight, so a new job may begin at once."""
        return self.runner.job is None and self._turn is None

    @property
    def takes_frames(self) -> bool:
        """A frame might be transmitted now, before the turn under way ends."""
        return self._turn is None

    @property
    def deadline(self) -> float | None:
        """When the oldest turn under way counts as missed."""
        return None if self._turn is None else self._turn.deadline

    # Callers

    def submit(self, job: Job, now: float) -> bool:
        """Queue a request or a plan; return whether the next action may be due now. Raises LinkDown, Overloaded."""
        if not self.up:
            raise LinkDown("the line is down: it is opened again as soon as the port is back; retry then", bus=self.bus)
        if (
            self.runner.job is None
            and self._turn is None
            and job.plan is None
            and self.runner.suspended is None
            and self.line.is_ready(now)
            and self.scheduler.begins_at_once(job, now)
        ):
            self.runner.job = job
            return True
        self.scheduler.queue(job, now)
        return self.idle

    def submit_stop(self, job: Job) -> None:
        """Put a stop before all that waits. An e-stop also drops what moves, and interrupts the plan under way. Raises
        LinkDown."""
        if not self.up:
            raise LinkDown("the line is down: nothing can be stopped through it", bus=self.bus)
        if job.kind is ESTOP:
            self.scheduler.drop(self.runner.estopped, motion_only=True)
        self.scheduler.put_stop(job)

    # The line

    def opened(self, now: float) -> None:
        self.up = True
        self._reset_codec()
        self.nodes.suspect_all()
        self.line.opened(now)

    def baudrate_changed(self, baudrate: int, now: float) -> None:
        self.line.use(replace(self.line.traits, baudrate=baudrate))
        self.line.wait_for_silence(now)

    def lost(self, cause: Exception | None) -> None:
        """End everything: the line is gone. `cause` is None where we closed it ourselves."""
        self.up = False
        self.deliver()
        begun = [self.runner.job, self.runner.suspended, *self._drop_turns()]
        self.runner.job = self.runner.suspended = None
        self.nodes.suspect_all()
        self.stats.counts[Counter.LINE_LOST] += cause is not None
        reason = str(cause) if cause else "closed"
        for job in dict.fromkeys(begun):
            if job is not None:
                job.fail(LinkDown(f"the line went down while this was under way ({reason}){job.applied}", bus=self.bus))
        self.scheduler.drop(
            lambda _: LinkDown(f"the line went down ({reason}): nothing was sent", bus=self.bus), motion_only=False
        )

    def _drop_turns(self) -> list[Job]:
        """Forget the turns under way; return their jobs."""
        turn, self._turn = self._turn, None
        return [] if turn is None else [turn.job]

    # What is transmitted next

    def next_action(self, now: float) -> Action:
        """Return what is to be done now. After a Transmit, ask again."""
        if self._unanswered is not None:
            self.deliver()
        if self._turn is not None or not self.up:
            if self._ended is not None:
                self.deliver()
            return IDLE
        line = self.line
        if not line.is_ready(now):
            ready = line.ready_at(now, estop_pending=self.runner.estop_pending)
            if ready > now:
                return self._wait_for_line(ready, now)
            if line.waiting_for_silence:
                self._reset_codec()
                line.end_wait()
        request = self.runner.next_request(now)
        if request is not None:
            return self._transmit(request, now)
        if self._ended is not None:
            self.deliver()
        when = self.scheduler.rest(now)
        return IDLE if when is None else WaitUntil(when)

    def _wait_for_line(self, ready: float, now: float) -> Action:
        self.deliver()
        if self.line.babbling and self.runner.job is not None and self.runner.job.kind is not ESTOP:
            job, self.runner.job = self.runner.job, None
            message = "the line never falls silent: look for a second master or a servo that sends without being asked"
            job.fail(ReplyTimeout(message, bus=self.bus))
        if self.runner.job is None and self.runner.suspended is None and self.scheduler.is_empty():
            # Whoever submits a job asks again; until then no timer is needed for the line.
            due = self.scheduler.polls.due
            return IDLE if due == math.inf else WaitUntil(max(ready, due))
        self.scheduler.expire(now)
        return WaitUntil(ready)

    def _transmit(self, request: Request[Any], now: float) -> Transmit:
        job, line, counts = self.runner.job, self.line, self.stats.counts
        assert job is not None
        frame, replies, byte_time = request.frame, request.replies, line.byte_time
        start = line.send(frame, now, 0.0 if replies else request.quiet_after)
        counts[FRAMES] += 1
        counts[BYTES_SENT] += len(frame)
        if not replies:
            self.stats.busy += len(frame) * byte_time
            self._unanswered = job
            return Transmit(frame, None)
        reply_time = replies * request.reply_size * byte_time
        self.stats.busy += len(frame) * byte_time + reply_time
        turn = Turn(frame, line.sent_by + reply_time + self._allowance(request), request, job, start, line.sent_by)
        self._begin_turn(turn)
        return turn

    def _allowance(self, request: Request[Any]) -> float:
        """Return the seconds beyond the wire time in which the replies may come."""
        nodes = self.nodes
        ids = request.nodes
        node = nodes.by_id.get(request.node) or nodes.node(request.node)
        slowest = node.reply_allowance_s if len(ids) < 2 else max(nodes.node(each).reply_allowance_s for each in ids)
        return slowest + self.line.traits.latency + request.service_time

    def _begin_turn(self, turn: Turn) -> None:
        if self._buffering:
            self._reset_codec()
        self._turn = turn

    def _reset_codec(self) -> None:
        self._codec.reset()
        self._buffering = False
        self._skipped_before = self._codec.skipped

    # What is received

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the line."""
        self.stats.counts[BYTES_RECEIVED] += len(data)
        line, turn = self.line, self._turn
        if line.echo is not None and not (data := line.echo.strip(data)):
            return
        if turn is None or (line.paced and self._is_early(len(data), now, turn)):
            self._unsolicited(data, now)
            return
        if not self._buffering and data != turn.frame and not turn.replies:
            reply = turn.request.whole_reply(data)
            if reply is not None:
                # Nearly always the bytes are exactly the reply that is due: the codec and `judge` would find the same.
                turn.replies.append(reply)
                self._answered(turn, now)
                return
        self._buffering = True
        self._codec.receive_data(data)
        window, strays = self._judge(turn)
        if strays:
            self._strays(strays, turn, now)
        if window is BELIEVED:
            self._answered(turn, now)
        elif window is not WINDOW_OPEN:
            self.stats.counts[Counter.REJECTED_WINDOWS] += 1
            self._missed(turn, now)

    def _judge(self, turn: Turn) -> tuple[Window, tuple[Reply, ...]]:
        return judge(self._codec, turn)

    def _is_early(self, size: int, now: float, turn: Turn) -> bool:
        """Return whether the first of these bytes was on the wire before the request had left."""
        wire_time = (min(size, turn.request.reply_size) - 0.5) * self.line.byte_time
        return now - wire_time < turn.sent_by and not (turn.replies or self._codec.pending)

    def _unsolicited(self, data: bytes, now: float) -> None:
        """Discard bytes that came while no reply was due, or before the request had left, and wait for silence before the next
        frame. The nodes of valid frames among them become doubtful."""
        self.stats.counts[Counter.UNSOLICITED_BYTES] += len(data)
        self.line.greeted(data)
        self._codec.receive_data(data)
        strays: list[Reply] = []
        while (reply := self._codec.next_reply()) is not None:
            strays.append(reply)
        self._strays(strays, None, now)
        self._reset_codec()  # the rest of them is not the beginning of a reply
        if self._turn is None:
            self.line.wait_for_silence(now)

    def _strays(self, replies: tuple[Reply, ...] | list[Reply], turn: Turn | None, now: float) -> None:
        """Doubt the nodes of valid frames that answer nothing: each may have replied twice, or late."""
        for reply in replies:
            self.stats.counts[Counter.STRAYS] += 1
            node = self.nodes.node(reply.node)
            node.late(reply.key, now)
            node.causes[Cause.LATE] += turn is None or turn.cause_of(reply) is not Cause.NO_ANSWER
            asked = turn is not None and reply.node in turn.request.nodes
            if turn is not None:
                self._foreign = turn, turn.cause_of(reply)
            if node.configured or asked:
                self.nodes.doubt(node, reply.key, node.outstanding.get(reply.key, now))

    # How a turn ends

    def timed_out(self, now: float) -> None:
        """End the oldest turn under way if its deadline has passed."""
        turn = self._turn
        if turn is not None and now >= turn.deadline:
            self._missed(turn, now)

    def extend(self, deadline: float) -> None:
        """Move the deadline of the oldest turn under way; only once."""
        turn = self._turn
        if turn is not None and not turn.extended:
            turn.extended = True
            turn.deadline = deadline

    def _answered(self, turn: Turn, now: float) -> None:
        """All replies are here."""
        counts, request = self.stats.counts, turn.request
        self._end_turn(turn)
        counts[TURNS] += 1
        if turn.echoes:
            counts[ECHOES] += turn.echoes
        self.stats.turns.add(now - turn.sent_at)
        if not counts[TURNS] & FOLD_MASK:
            self.stats.turns.fold()
        if self._turn is None:
            self.line.answered(now, request.quiet_after)
        latency = now - turn.sent_by - len(turn.replies) * request.reply_size * self.line.byte_time
        by_id = self.nodes.by_id
        for reply in turn.replies:
            node = by_id.get(reply.node) or self.nodes.node(reply.node)
            node.replied(reply.status, latency)
        if request.relayed and request.is_silence(turn.replies):
            for node_id in request.nodes:
                self._count_miss(node_id, Cause.NO_ANSWER, turn, now)
        job = turn.job
        if job.plan is None and not job.fencing:
            if self.runner.job is job:
                self.runner.job = None
            if self._ended is not None:
                self.deliver()
            self._ended = turn
        else:
            self.runner.conclude(job, request, turn.replies)

    def _missed(self, turn: Turn, now: float) -> None:
        """A reply is missing, or the window cannot be believed."""
        self._end_turn(turn)
        cause = self._cause(turn)
        request, counts = turn.request, self.stats.counts
        counts[Counter.TIMEOUTS] += 1
        counts[ECHOES] += turn.echoes
        self.line.wait_for_silence(now, max(QUIET, request.quiet_after))
        rejected = turn.complete()
        for node_id in request.nodes if rejected else turn.missing():
            self._count_miss(node_id, cause, turn, now)
        if request.partial and turn.replies and not rejected:
            for reply in turn.replies:  # how soon they came is not known: the deadline ended this turn
                self.nodes.node(reply.node).answered(reply.status)
            self.runner.conclude(turn.job, request, turn.replies)
        else:
            self.runner.retry(turn, cause, now)

    def _count_miss(self, node_id: int, cause: Cause, turn: Turn, now: float) -> None:
        node = self.nodes.node(node_id)
        node.causes[cause] += 1
        self.nodes.missed(node, turn.request.reply_key, turn.sent_at, now)

    def _cause(self, turn: Turn) -> Cause:
        """Return why a turn has no value, from what arrived in it."""
        if self._foreign is not None and self._foreign[0] is turn:
            return self._foreign[1]
        garbage = self._buffering and self._codec.skipped + self._codec.pending > self._skipped_before
        return Cause.GARBLED if garbage else Cause.SILENT

    def _end_turn(self, turn: Turn) -> None:
        self._turn = None

    # Results

    def deliver(self) -> None:
        """Hand the value of the last plain request to its caller, and conclude a request that was sent without a reply due.

        `next_action` calls this once the next frame is on its way, so that the line does not wait for it.
        """
        turn, self._ended = self._ended, None
        if turn is not None:
            self.runner.conclude(turn.job, turn.request, turn.replies)
        job, self._unanswered = self._unanswered, None
        if job is not None:
            self.runner.conclude(job, job.request, ())
