"""Writes docs/events-and-counters.md from the enums: `python -m tests.docs.events_page`, which `scripts/docs` runs."""

from __future__ import annotations

from collections.abc import Iterator

from servobus.engine.stats import Counter
from servobus.values import EventName, Health
from tests.docs.blocks import ROOT

PATH = ROOT / "docs" / "events-and-counters.md"
HEAD = """\
# Events and counters

`scripts/docs` writes this page from the enums `servobus.values.EventName` and `servobus.engine.stats.Counter`; edit those.

## Events

`rig.events()` and the topic `events` of the daemon tell what happens. Each event has a name, a time and these fields.

| event | meaning | fields |
|---|---|---|
"""
COUNTERS = """
## Counters

`rig.stats()` and `servobus stats` have these for each bus, since it was opened. Beside them are `up` (the line is open),
`waiting` (queued jobs), `wire_load_percent`, `turn_ms` (duration of turns: p50, p99, max), and for each node its `health`,
`misses` (replies missed in a row) and `deadline_ms` (how long servobus waits for a reply).

| counter | meaning |
|---|---|
"""
HEALTH = f"""
A node is one of {", ".join(f"`{health}`" for health in Health)}; [architecture.md](architecture.md) says how it changes.

## Which counter grows

| it grows | look at |
|---|---|
| `timeouts` of one servo | its power, its cable, its baud rate |
| `timeouts` of all servos of a bus | the adapter, the line's direction control, `timeout_ms` |
| `rejected_windows`, `strays` | noise, termination, two servos with one id, a second master on the line |
| `unsolicited_bytes` | another program or another master uses the line |
| `collisions` | two senders at once: a second master, or a servo that replies too late |
| `polls_missed` | `servobus check`: the rates ask for more than the line carries |
| `restarts` | the supply breaks down under load |
| `goals_superseded` | callers send faster than the line carries; the newest goal wins |
"""


def page() -> str:
    return HEAD + "".join(_events()) + COUNTERS + "".join(_counters()) + HEALTH


def _events() -> Iterator[str]:
    for event in EventName:
        fields = ", ".join(f"`{field}`" for field in event.fields)
        yield f"| `{event}` | {event.description} | {fields} |\n"


def _counters() -> Iterator[str]:
    for counter in Counter:
        yield f"| `{counter}` | {counter.description} |\n"


if __name__ == "__main__":
    PATH.write_text(page())
