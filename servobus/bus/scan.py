"""Scans a line for servos: every id at every rate, one request at a time (broadcast questions are for a single servo only)."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence

from servobus.bus.service import BusService
from servobus.engine.stats import Cause, Counter
from servobus.errors import DeviceError, NotSupported, ReplyTimeout

GARBLED_TRIES = 3
"""Times an id is asked whose reply came garbled."""
Hit = tuple[int, int, str | None, str | None, str | None, str]
"""Id, baud rate, model, product, firmware, note."""


async def scan(
    bus: BusService, baudrates: Sequence[int], ids: Sequence[int]
) -> AsyncGenerator[tuple[int, int, Hit | None], None]:
    """Yield (ids asked so far, ids in all, hit or None) for each id.

    The bus's own rate is restored whatever happens. Raises NotSupported, Busy, LinkDown.
    """
    own = bus.options.baudrate
    if any(rate != own for rate in baudrates) and not bus.line.traits.can_change_baud:
        raise NotSupported("this line cannot change its baud rate: scan at its own", bus=bus.name)
    asked, count = 0, len(baudrates) * len(ids)
    async with bus.exclusive() as session:
        try:
            for rate in baudrates:
                bus.set_baudrate(rate)
                for node in ids:
                    hit = await _ask(bus, node, rate, session)
                    asked += 1
                    yield asked, count, hit
        finally:
            bus.set_baudrate(own)


async def _ask(bus: BusService, node: int, rate: int, session: object) -> Hit | None:
    """Ask one id. Silence is believed at once; an id whose reply came garbled is asked again."""
    causes = bus.nodes.node(node).causes
    for _ in range(GARBLED_TRIES):
        garbled = causes[Cause.GARBLED]
        if await _answers(bus, node, session):
            return await _identity(bus, node, rate, session)
        if causes[Cause.GARBLED] == garbled:
            break
    return None


async def _answers(bus: BusService, node: int, session: object) -> bool:
    request = bus.driver.ping(node)
    echoes = bus.stats.counts[Counter.ECHOES]
    try:
        await bus.ask(request, even_if_offline=True, session=session, tries=1)
    except ReplyTimeout:
        plain = request.plain()
        if plain is None or bus.stats.counts[Counter.ECHOES] == echoes:
            return False
        # A frame like the request came back: its echo, or a servo whose fault makes its reply look so. Ask so that they differ.
        try:
            await bus.ask(plain, even_if_offline=True, session=session, tries=1)
        except ReplyTimeout:
            return False
    return True


async def _identity(bus: BusService, node: int, rate: int, session: object) -> Hit:
    try:
        identity = await bus.perform(bus.driver.inspect(node), node, even_if_offline=True, session=session)
    except (ReplyTimeout, DeviceError):
        return node, rate, None, None, None, "answers, but not who it is: two servos with this id?"
    return node, rate, identity.model, identity.product, identity.firmware, "; ".join(identity.notes)
