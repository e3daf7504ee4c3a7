"""Looks for servos: every id, one after the other (the seed forbids broadcast questions on a line of several), at every rate."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from typing import TYPE_CHECKING

from servobus.errors import DeviceError, NotSupported, ReplyTimeout

if TYPE_CHECKING:
    from servobus.bus.service import BusService

Hit = tuple[int, int, str | None, str | None, str | None, str]
"""Id, baud rate, model, product, firmware, note."""


async def scan(
    bus: BusService, baudrates: Sequence[int], ids: Sequence[int]
) -> AsyncGenerator[tuple[int, int, Hit | None], None]:
    """Yields (asked so far, in all, what was found). The bus's own rate is restored whatever happens. Raises NotSupported,
    LeaseHeld, LinkDown."""
    own = bus.options.baudrate
    if any(rate != own for rate in baudrates) and not bus.line.traits.can_change_baud:
        raise NotSupported("this line cannot change its baud rate: scan at its own", bus=bus.name)
    asked, count = 0, len(baudrates) * len(ids)
    async with bus.exclusive() as session:
        try:
            for rate in baudrates:
                bus.set_baudrate(rate)
                for node in ids:
                    hit = await _look(bus, node, rate, session)
                    asked += 1
                    yield asked, count, hit
        finally:
            bus.set_baudrate(own)


async def _look(bus: BusService, node: int, rate: int, session: object) -> Hit | None:
    question = bus.driver.ping(node)
    echoes = bus.stats.counts["echoes"]
    try:
        await bus.ask(question, urgent=True, session=session, tries=1)
    except ReplyTimeout:
        plain = question.plain()
        if plain is None or bus.stats.counts["echoes"] == echoes:
            return None
        # What came looked like the question: an echo, or a servo whose fault makes its answer look so. Ask so that they differ.
        try:
            await bus.ask(plain, urgent=True, session=session, tries=1)
        except ReplyTimeout:
            return None
    try:
        seen = await bus.perform(bus.driver.inspect(node), node, urgent=True, session=session)
    except (ReplyTimeout, DeviceError):
        return node, rate, None, None, None, "answers, but not who it is: two servos with this id?"
    return node, rate, seen.model, seen.product, seen.firmware, "; ".join(seen.notes)
