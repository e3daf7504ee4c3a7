"""The engine of one line: bytes and times go in, frames and deadlines come out. Pure: no asyncio, no clock, no port.

Whoever runs it reports what happens (`opened`, `receive`, `timed_out`, `lost`, `submit`) and then asks `next_action(now)`
until that is not a `Transmit` any more. Half duplex: one turn at a time. A plan keeps the line from its first frame to
its last; only an e-stop comes between.

Before each frame the engine goes through these cases:

1. A turn is under way: nothing is transmitted before its replies are here or its deadline has passed.
2. The line must be silent for a while (it was opened, a reply is missing, bytes came unasked): wait. Only an e-stop is
   transmitted on a line that never falls silent; any plan under way fails then.
3. An e-stop waits: a plan that moves something fails, any other plan is suspended and goes on afterwards. An e-stop
   never interrupts an earlier one: a hold that goes on after a limp would switch the torque on again.
4. The request could have a reply that is mistaken for a late one, because a node of it is doubtful: a fence comes first.
   Requests without a reply need none, and the requests of a fence are not fenced themselves.
5. Otherwise the request is transmitted. With no reply due, its value is there at once.

How a turn ends:

1. Every reply was believed: the request has its value, or the error that the reply tells.
2. Some replies of a group read are missing: those that came count, the silent nodes become doubtful.
3. A reply is missing, or the window was rejected: the silent nodes become doubtful, and the line must fall silent. The
   request is sent once more if it is idempotent, has tries left, belongs to no fence, its nodes are not offline and, where
   it moves something, its time has not passed. A request retried alone lets the other nodes have their turns first.
4. The line was lost: everything ends with LinkDown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, TypeAlias

from servobus.engine.health import OFFLINE, ONLINE, Node
from servobus.engine.job import Done, Failed, Job, JobKind, NodeRestarted, Step
from servobus.engine.line import QUIET, Line
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats, Counter
from servobus.engine.turn import Transmit, Turn, Window, judge
from servobus.errors import EStopped, LinkDown, NotEnabled, ReplyTimeout, ServobusError
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
        self._job: Job | None = None
        """The job that has the line: a plan, or the request under way."""
        self._suspended: Job | None = None
        """A plan that goes on after the e-stop."""
        self._turn: Turn | None = None
        """The oldest turn under way."""
        self._ended: Turn | None = None
        """A turn of a plain job whose value was not delivered yet: the next frame goes first."""
        self._unanswered: Job | None = None
        """The job of a frame to which no reply is due, and which is being handed over now."""
        self._buffering = False
        """The codec was given bytes since it was reset."""

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
        return self._job is None and self._turn is None

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
            self._job is None
            and self._turn is None
            and job.plan is None
            and self._suspended is None
            and self.line.is_ready(now)
            and self.scheduler.begins_at_once(job, now)
        ):
            self._job = job
            return True
        self.scheduler.queue(job, now)
        return self.idle

    def submit_stop(self, job: Job) -> None:
        """Put a stop before all that waits. An e-stop also drops what moves, and interrupts the plan under way. Raises
        LinkDown."""
        if not self.up:
            raise LinkDown("the line is down: nothing can be stopped through it", bus=self.bus)
        if job.kind is ESTOP:
            self.scheduler.drop(self.estopped, motion_only=True)
        self.scheduler.put_stop(job)

    def estopped(self, servo: str) -> ServobusError:
        return EStopped("the e-stop came first: nothing more was sent", bus=self.bus, servo=servo or None)

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
        begun = [self._job, self._suspended, *self._drop_turns()]
        self._job = self._suspended = None
        self.nodes.suspect_all()
        self.stats.counts[Counter.LINE_LOST] += cause is not None
        reason = str(cause) if cause else "closed"
        for job in dict.fromkeys(begun):
            if job is not None:
                message = f"the line went down while this was under way ({reason}): it may have been applied"
                job.fail(LinkDown(message, bus=self.bus))
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
            ready = line.ready_at(now, estop_pending=self.estop_pending)
            if ready > now:
                return self._wait_for_line(ready, now)
            if line.waiting_for_silence:
                self._reset_codec()
                line.end_wait()
        request = self._next_request(now)
        if request is not None:
            return self._transmit(request, now)
        if self._ended is not None:
            self.deliver()
        when = self.scheduler.rest(now)
        return IDLE if when is None else WaitUntil(when)

    @property
    def estop_pending(self) -> bool:
        """An e-stop waits or is under way: it is transmitted even on a line that never falls silent."""
        return self.scheduler.estop_pending or (self._job is not None and self._job.kind is ESTOP)

    def _wait_for_line(self, ready: float, now: float) -> WaitUntil:
        self.deliver()
        if self.line.babbling and self._job is not None and self._job.kind is not ESTOP:
            job, self._job = self._job, None
            message = "the line never falls silent: look for a second master or a servo that sends without being asked"
            job.fail(ReplyTimeout(message, bus=self.bus))
        self.scheduler.expire(now)
        return WaitUntil(ready)

    def _next_request(self, now: float) -> Request[Any] | None:
        """Return the next request of the job under way or of the next job, behind a fence where one is due."""
        while (job := self._current_job(now)) is not None:
            request = job.request
            if not request.replies or job.fencing:
                return request
            doubtful = self._doubtful_node(request)
            if doubtful is None:
                return request
            self.stats.counts[Counter.FENCES] += 1
            self._apply(job, job.put_fence(self.scheduler.fence(doubtful)))
        return None

    def _current_job(self, now: float) -> Job | None:
        """Return the job that has the line, begun if need be."""
        job = self._job
        if job is None:
            if self._suspended is None:
                job = self.scheduler.next_job(now)
                if job is None or job.plan is None:  # nearly always
                    self._job = job
                    return job
                self._begin(job)
        elif job.kind is not ESTOP and self.scheduler.estop_pending:
            self._make_way(job)
        while self._job is None:
            if self._suspended is not None and not self.scheduler.estop_pending:
                self._job, self._suspended = self._suspended, None
                return self._job
            job = self.scheduler.next_job(now)
            if job is None:
                return None
            self._begin(job)
        return self._job

    def _begin(self, job: Job) -> None:
        self._job = job
        if job.plan is not None:
            self.stats.counts[Counter.FENCES] += job.kind is JobKind.PROBE
            self._apply(job, job.begin())

    def _make_way(self, job: Job) -> None:
        self._job = None
        if job.kind is JobKind.MOTION:
            job.fail(self.estopped(""))
        else:
            self._suspended = job

    def _doubtful_node(self, request: Request[Any]) -> Node | None:
        by_id = self.nodes.by_id
        for node_id in request.nodes:
            node = by_id.get(node_id) or self.nodes.node(node_id)
            if node.health is not ONLINE:
                return node
        return None

    def _transmit(self, request: Request[Any], now: float) -> Transmit:
        job, line, counts = self._job, self.line, self.stats.counts
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
        turn = Turn(request, job, start, line.sent_by, line.sent_by + reply_time + self._allowance(request))
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
            if node.configured or (turn is not None and reply.node in turn.request.nodes):
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
        self._end_turn(turn)
        counts, request = self.stats.counts, turn.request
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
        job = turn.job
        if job.plan is None and not job.fencing:
            if self._job is job:
                self._job = None
            if self._ended is not None:
                self.deliver()
            self._ended = turn
        else:
            self._conclude(job, request, turn.replies)

    def _missed(self, turn: Turn, now: float) -> None:
        """A reply is missing, or the window cannot be believed."""
        self._end_turn(turn)
        request, counts = turn.request, self.stats.counts
        counts[Counter.TIMEOUTS] += 1
        counts[ECHOES] += turn.echoes
        self.line.wait_for_silence(now, max(QUIET, request.quiet_after))
        rejected = turn.complete()
        for node_id in request.nodes if rejected else turn.missing():
            self.nodes.missed(self.nodes.node(node_id), request.reply_key, turn.sent_at, now)
        if request.partial and turn.replies and not rejected:
            for reply in turn.replies:  # how soon they came is not known: the deadline ended this turn
                self.nodes.node(reply.node).answered(reply.status)
            self._conclude(turn.job, request, turn.replies)
        else:
            self._retry(turn, now)

    def _end_turn(self, turn: Turn) -> None:
        self._turn = None

    def _retry(self, turn: Turn, now: float) -> None:
        """Send the request once more, or give it up: case 3 above."""
        job, request = turn.job, turn.request
        job.attempts += 1
        offline = any(self.nodes.node(node).health is OFFLINE for node in request.nodes)
        too_late = job.kind is JobKind.MOTION and now >= job.expires
        # The request of a fence is not repeated as it was: its reply may still come, and must be fenced again.
        if not request.idempotent or job.fencing or too_late or job.attempts >= job.tries or offline:
            self._apply(job, job.give_up(self._timeout(job.attempts, request), offline=offline))
            return
        self.stats.counts[Counter.RETRIES] += 1
        job.request = (request.plain() if turn.echoes else None) or request
        if job.plan is None:
            if self._job is job:
                self._job = None
            self.scheduler.retry(job)

    def _timeout(self, attempts: int, request: Request[Any]) -> ReplyTimeout:
        tries = "1 try" if attempts == 1 else f"{attempts} tries"
        return ReplyTimeout(
            f"no answer after {tries}: is it powered, are id and baud rate right? What was asked may have been applied",
            bus=self.bus,
            request=request,
            raw=request.frame,
        )

    # Results

    def deliver(self) -> None:
        """Hand the value of the last plain request to its caller, and conclude a request that was sent without a reply due.

        `next_action` calls this once the next frame is on its way, so that the line does not wait for it.
        """
        turn, self._ended = self._ended, None
        if turn is not None:
            self._conclude(turn.job, turn.request, turn.replies)
        job, self._unanswered = self._unanswered, None
        if job is not None:
            self._conclude(job, job.request, ())

    def _conclude(self, job: Job, request: Request[Any], replies: Sequence[Reply]) -> None:
        """Parse the replies of a turn, and go on with its job."""
        try:
            value = request.parse(replies)
        except Exception as error:  # noqa: BLE001 - a mistake in a driver ends its job, never the bus
            self._apply(job, job.give_up(error))
            return
        if job.plan is None and not job.fencing:
            if self._job is job:
                self._job = None
            if not job.sink.done():
                job.sink.set_result(value)
        else:
            self._apply(job, job.advance(value))

    def _apply(self, job: Job, step: Step) -> None:
        """Keep the job on the line, or end it."""
        error: Exception | None = None
        if isinstance(step, NodeRestarted) and job.kind is JobKind.MOTION:
            error = NotEnabled("the servo has restarted and is disabled: nothing was sent; enable it again")
        elif isinstance(step, Failed):
            error = step.error
        elif not isinstance(step, Done):
            return
        if self._job is job:
            self._job = None
        if isinstance(step, Done):
            job.succeed(step.value)
        elif error is not None:
            job.fail(error.at(bus=self.bus) if isinstance(error, ServobusError) else error)
