"""What a bus counts, and how long its turns take. Pure: told everything, asks nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

SUB_BUCKETS = 8
"""Per doubling, so a percentile is true to within 1/8."""


class Histogram:
    """Durations in buckets of logarithmic width, from a microsecond up; bounded whatever it is fed."""

    __slots__ = ("_buckets", "count", "greatest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0.0
        self.greatest = 0.0
        self._buckets = [0] * (SUB_BUCKETS * 40)

    def add(self, seconds: float) -> None:
        self.count += 1
        self.total += seconds
        if seconds > self.greatest:
            self.greatest = seconds
        microseconds = int(seconds * 1e6)
        if microseconds < SUB_BUCKETS:
            self._buckets[max(microseconds, 0)] += 1
            return
        shift = microseconds.bit_length() - 4
        index = (shift + 1) * SUB_BUCKETS + (microseconds >> shift) - SUB_BUCKETS
        self._buckets[min(index, len(self._buckets) - 1)] += 1

    def percentile(self, share: float) -> float:
        """Seconds that `share` (0 to 1) of the durations do not exceed; 0 when there are none."""
        wanted = share * self.count
        seen = 0
        for upper, count in self.buckets():
            seen += count
            if seen >= wanted:
                return min(upper, self.greatest)
        return self.greatest

    def buckets(self) -> Iterator[tuple[float, int]]:
        """Upper bound in seconds and count of every bucket that is not empty, ascending."""
        for index, count in enumerate(self._buckets):
            if count:
                shift, step = divmod(index, SUB_BUCKETS)
                upper = index + 1 if shift == 0 else (SUB_BUCKETS + step + 1) << (shift - 1)
                yield upper / 1e6, count


class BusStats:
    """Counters and histograms of one bus."""

    __slots__ = ("busy", "counts", "started", "turns")

    def __init__(self, now: float) -> None:
        self.counts: Counter[str] = Counter()
        self.turns = Histogram()
        self.busy = 0.0
        """Seconds of wire time said and heard."""
        self.started = now

    def snapshot(self, now: float) -> dict[str, object]:
        """For people and machines: plain numbers, durations in milliseconds, load in percent."""
        elapsed = now - self.started
        return {
            **{name: self.counts[name] for name in sorted(self.counts)},
            "wire_load_percent": round(100 * self.busy / elapsed, 1) if elapsed > 0 else 0.0,
            "turn_ms": {
                "p50": round(1e3 * self.turns.percentile(0.50), 3),
                "p99": round(1e3 * self.turns.percentile(0.99), 3),
                "max": round(1e3 * self.turns.greatest, 3),
            },
        }
