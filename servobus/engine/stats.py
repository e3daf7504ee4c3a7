"""What a bus counts, and how long its turns take. Pure: it is told everything and asks for nothing."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Iterator, Mapping

from servobus.values import Described

SUB_BUCKETS = 8
"""Per doubling, so a percentile is true to within 1/8."""


class Counter(Described):
    """The counters of a bus, under the names that `servobus stats` shows."""

    FRAMES = "frames", "Frames sent."
    BYTES_SENT = "bytes_sent", "Bytes sent."
    BYTES_RECEIVED = "bytes_received", "Bytes received, echoes and garbage included."
    TURNS = "turns", "Requests that received all their replies."
    TIMEOUTS = "timeouts", "Requests whose replies did not all arrive in time, or could not be believed."
    RETRIES = "retries", "Requests that were sent once more."
    FENCES = "fences", "Fences sent before a doubtful node was believed again."
    STRAYS = "strays", "Valid frames that answered no request."
    REJECTED_WINDOWS = "rejected_windows", "Replies discarded because bytes that are not a valid frame followed them."
    UNSOLICITED_BYTES = "unsolicited_bytes", "Bytes received while no reply was due."
    ECHOES = "echoes", "Own requests that came back."
    COLLISIONS = "collisions", "Times that other bytes arrived where the echo of our own was due."
    DRAINS = "drains", "Times that the line was left silent until stray bytes had passed."
    LINE_LOST = "line_lost", "Times that the line was lost."
    RESTARTS = "restarts", "Nodes found to have restarted."
    POLLED = "polled", "Servo states brought by polls."
    POLLS_MISSED = "polls_missed", "Poll times that passed without their poll, because the line was busy."
    GOALS = "goals", "Goals accepted."
    GOALS_ACKED = "goals_acked", "Goals that the servo confirmed."
    GOALS_SENT = "goals_sent", "Goals sent without a confirmation, because the protocol has none."
    GOALS_SUPERSEDED = "goals_superseded", "Goals replaced by a newer goal of the same servo before they were sent."
    GOALS_FAILED = "goals_failed", "Goals that ended with an error."
    GOALS_CLAMPED = "goals_clamped", "Goals moved to the nearest value inside a limit (`on_limit: clamp`)."
    GOAL_TURNS = "goal_turns", "Goal plans begun; each carries the goals of one or more servos."
    GOAL_GROUPS_SPLIT = "goal_groups_split", "Groups of goals that did not fit one plan."


class Cause(Described):
    """Why a request has no value: counted for each node, and named in the error."""

    SILENT = "silent", "Nothing arrived."
    GARBLED = "garbled", "Bytes arrived that are no valid reply."
    FOREIGN = "foreign", "Valid replies of other nodes arrived, and none of this one."
    LATE = "late", "A reply arrived after its request was given up, or twice."
    NO_ANSWER = "no_answer", "A gateway reported that the node did not answer it."
    REFUSED = "refused", "The node answered, and refused."


class Histogram:
    """Durations in buckets of logarithmic width, from a microsecond up; its size never grows.

    `add` is the append of a list, because every turn adds one; `fold` sorts the list into the buckets now and then.
    """

    __slots__ = ("_buckets", "_count", "_max", "_new", "_total", "add")

    def __init__(self) -> None:
        self._new: list[float] = []
        self.add = self._new.append
        """Add one duration in seconds; whoever adds many calls `fold` at times."""
        self._count = 0
        self._total = 0.0
        self._max = 0.0
        self._buckets = [0] * (SUB_BUCKETS * 40)

    @property
    def count(self) -> int:
        self.fold()
        return self._count

    @property
    def total(self) -> float:
        """Seconds."""
        self.fold()
        return self._total

    @property
    def max(self) -> float:
        """Seconds."""
        self.fold()
        return self._max

    def fold(self) -> None:
        """Sort the new durations into the buckets."""
        if not self._new:
            return
        self._count += len(self._new)
        self._total += sum(self._new)
        self._max = max(self._max, *self._new)
        for microseconds, count in Tally([int(seconds * 1e6) for seconds in self._new]).items():
            self._buckets[_bucket(microseconds)] += count
        self._new.clear()

    def percentile(self, share: float) -> float:
        """Return the seconds that `share` (0 to 1) of the durations do not exceed; 0 while there are none."""
        wanted = share * self.count
        total = 0
        for upper, count in self.buckets():
            total += count
            if total >= wanted:
                return min(upper, self.max)
        return self.max

    def buckets(self) -> Iterator[tuple[float, int]]:
        """Upper bound in seconds and count of every bucket that is not empty, ascending."""
        self.fold()
        for index, count in enumerate(self._buckets):
            if count:
                shift, step = divmod(index, SUB_BUCKETS)
                upper = index + 1 if shift == 0 else (SUB_BUCKETS + step + 1) << (shift - 1)
                yield upper / 1e6, count


def _bucket(microseconds: int) -> int:
    if microseconds < SUB_BUCKETS:
        return max(microseconds, 0)
    shift = microseconds.bit_length() - 4
    return min((shift + 1) * SUB_BUCKETS + (microseconds >> shift) - SUB_BUCKETS, SUB_BUCKETS * 40 - 1)


NO_COUNTS: Mapping[Counter, int] = {}


class BusStats:
    """Counters and histograms of one bus."""

    __slots__ = ("busy", "counts", "started", "turns")

    def __init__(self, now: float) -> None:
        self.counts = dict.fromkeys(Counter, 0)
        self.turns = Histogram()
        self.busy = 0.0
        """Seconds of wire time, sent and received."""
        self.started = now

    def snapshot(self, now: float, more: Mapping[Counter, int] = NO_COUNTS) -> dict[str, object]:
        """Plain numbers for people and machines: durations in milliseconds, load in percent. `more`: counters kept elsewhere."""
        elapsed = now - self.started
        return {
            **{counter.value: count for counter, count in sorted({**self.counts, **more}.items())},
            "wire_load_percent": round(100 * self.busy / elapsed, 1) if elapsed > 0 else 0.0,
            "turn_ms": {
                "p50": round(1e3 * self.turns.percentile(0.50), 3),
                "p99": round(1e3 * self.turns.percentile(0.99), 3),
                "max": round(1e3 * self.turns.max, 3),
            },
        }
