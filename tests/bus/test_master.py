"""The bus master on a line that does what the test says: turn-taking, lateness, echo, babble, e-stop between frames."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from servobus.engine.stats import Counter
from servobus.errors import ReplyTimeout
from servobus.protocols.base import LineTraits
from servobus.protocols.sms.codec import Instruction, encode
from tests.engine.scripted_line import Answers, puppet_bus
from tests.virtual_time import virtual

FENCE = 5
"""Address from which a fence reads."""


def read_of(node: int, address: int, size: int = 2) -> bytes:
    return encode(node, Instruction.READ, bytes((address, size)))


def reply(node: int, value: int, size: int = 2) -> bytes:
    return encode(node, 0, value.to_bytes(size, "little"))


def once(frame: bytes, answers: Answers) -> Callable[[bytes], Answers | None]:
    """These answers to the first such frame, the usual ones to all else."""
    left = [answers]
    return lambda request: left.pop() if request == frame and left else None


POSITION = read_of(1, 56)


@virtual
async def test_one_turn_at_a_time() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        open_turns, max_open = 0, 0

        def script(frame: bytes) -> Answers | None:
            nonlocal open_turns, max_open
            open_turns += 1
            max_open = max(max_open, open_turns)

            def ended() -> None:
                nonlocal open_turns
                open_turns -= 1

            asyncio.get_running_loop().call_later(0.001, ended)
            return None

        puppet.script = script
        await asyncio.gather(*(bus.read_register(servo, "present_position") for servo in ("s1", "s2") for _ in range(5)))
        assert max_open == 1


@virtual
async def test_a_late_reply_is_never_taken_for_the_next_one() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = once(POSITION, [(0.010, reply(1, 111))])
        value = await bus.read_register("s1", "present_position", raw=True)
        assert value == 0, "the late 111 was dropped, the retry's answer was taken"
        assert puppet.frames[0] == POSITION
        assert puppet.frames[1][5] == FENCE, "a fence went before the retry"
        assert bus.stats.counts[Counter.TIMEOUTS] == 1


@virtual
async def test_a_doubled_reply_makes_its_node_doubtful_and_nothing_else() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = once(POSITION, [(0.001, reply(1, 7) * 2)])
        assert await bus.read_register("s1", "present_position", raw=True) == 7
        assert bus.nodes.node(1).health == "doubtful"
        assert bus.nodes.node(2).health == "online"
        assert await bus.read_register("s1", "present_position", raw=True) == 0
        assert bus.nodes.node(1).health == "online"


@virtual
async def test_junk_behind_the_answer_rejects_it() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = once(POSITION, [(0.001, reply(1, 7) + b"\x55")])
        assert await bus.read_register("s1", "present_position", raw=True) == 0
        assert bus.stats.counts[Counter.REJECTED_WINDOWS] == 1


@virtual
async def test_bytes_nobody_asked_for_are_listened_out() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.say(reply(1, 7))
        started = bus.clock()
        assert await bus.read_register("s2", "present_position", raw=True) == 0
        assert bus.clock() - started >= 0.002
        assert bus.stats.counts[Counter.UNSOLICITED_BYTES] == 8
        assert any(frame[2] == 1 and frame[5] == FENCE for frame in puppet.frames), "the one who spoke was asked who it is"


@virtual
async def test_bytes_before_the_request_has_left_are_not_its_reply() -> None:
    paced = LineTraits(baudrate=200_000, paced=True)  # the question takes 0.4 ms
    async with puppet_bus(traits=paced) as (bus, puppet, _, _):
        puppet.script = once(POSITION, [(0.0003, reply(1, 9)), (0.002, reply(1, 8))])
        assert await bus.read_register("s1", "present_position", raw=True) == 8


@virtual
async def test_the_echo_of_a_request_is_never_its_reply() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: [(0.0005, frame)] if frame == POSITION else None
        assert await bus.read_register("s1", "present_position", raw=True) == 0
        assert read_of(1, 55, 3) in puppet.frames, "asked again so that its echo cannot be an answer"


@pytest.mark.parametrize(("echoes", "reported"), [(True, "on"), (False, "off")])
@virtual
async def test_auto_finds_out_whether_the_line_echoes(echoes: bool, reported: str) -> None:
    async with puppet_bus(echo="auto", started=False) as (bus, puppet, _, _):

        def script(frame: bytes) -> Answers | None:
            if frame[2] not in (1, 2):
                return [(0.0005, frame)] if echoes else []
            return [(0.0005, frame), *puppet.usual(frame)] if echoes else None

        puppet.script = script
        await bus.start()
        assert (bus.line.echo is not None) is echoes
        assert await bus.read_register("s1", "present_position", raw=True) == 0
        assert bus.stats.counts[Counter.TIMEOUTS] == 1, "only the probe's question had no answer"


@virtual
async def test_echo_on_takes_our_own_bytes_out() -> None:
    async with puppet_bus(echo="on", started=False) as (bus, puppet, _, _):
        puppet.script = lambda frame: [(0.0002, frame[:3]), (0.0004, frame[3:] + puppet.usual(frame)[0][1])]
        await bus.start()
        assert await bus.read_register("s2", "present_position", raw=True) == 0
        assert bus.stats.counts[Counter.TIMEOUTS] == 0


@virtual
async def test_a_node_that_never_stops_talking_holds_back_all_but_an_e_stop() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        loop = asyncio.get_running_loop()
        talking = True

        def babble() -> None:
            if talking:
                puppet.say(b"\x00")
                loop.call_later(0.0005, babble)

        babble()
        await asyncio.sleep(0.1)
        puppet.frames.clear()
        waiting = asyncio.create_task(bus.read_register("s1", "present_position", raw=True))
        stopping = asyncio.create_task(bus.stops.stop())
        await asyncio.sleep(0.5)
        assert puppet.frames, "the e-stop was sent"
        assert all(frame[4] != Instruction.READ or frame[5] != 56 for frame in puppet.frames[:1])
        talking = False
        await stopping
        assert await waiting == 0


@virtual
async def test_an_e_stop_goes_between_the_frames_of_a_plan() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        enabling = asyncio.create_task(bus.motion.enable("s1"))
        await asyncio.sleep(0.0015)
        sent = len(puppet.frames)
        assert sent > 0
        await bus.stops.stop()
        with pytest.raises(Exception, match="e-stop"):
            await enabling
        assert not bus.records["s1"].enabled


@virtual
async def test_a_reading_plan_goes_on_after_the_e_stop() -> None:
    async with puppet_bus() as (bus, _, _, _):
        asking = asyncio.create_task(bus.identify("s1"))
        await asyncio.sleep(0.0015)
        await bus.stops.stop()
        assert (await asking).firmware == "3.10"


@virtual
async def test_a_cancelled_caller_tears_no_turn() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        first = asyncio.create_task(bus.read_register("s1", "present_position"))
        second = asyncio.create_task(bus.read_register("s2", "present_position", raw=True))
        await asyncio.sleep(0.0005)
        first.cancel()
        with pytest.raises(asyncio.CancelledError):
            await first
        assert await second == 0
        assert [frame for frame in puppet.frames if frame[2] == 1] == [POSITION]
        assert bus.stats.counts[Counter.TIMEOUTS] == 0


@virtual
async def test_a_caller_cancelled_before_its_turn_costs_no_frame() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        first = asyncio.create_task(bus.read_register("s1", "present_position", raw=True))
        second = asyncio.create_task(bus.read_register("s2", "present_position"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        second.cancel()
        assert await first == 0
        await asyncio.sleep(0.1)
        assert [frame for frame in puppet.frames if frame[2] == 2] == []


@virtual
async def test_no_answer_ends_in_a_timeout_that_says_what_was_asked() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: [] if frame[2] == 1 else None
        with pytest.raises(ReplyTimeout, match="arm/s1") as caught:
            await bus.read_register("s1", "present_position")
        assert "powered" in str(caught.value)
        assert caught.value.raw
        assert bus.engine.idle


@virtual
async def test_what_arrived_and_was_not_read_yet_is_not_late() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        transport = bus.master._transport
        assert transport is not None
        polls = []

        class Polled:
            """The transport, with bytes that only a poll brings."""

            def __getattr__(self, name: str) -> object:
                return getattr(transport, name)

            def poll_input(self) -> bool:
                polls.append(bus.clock())
                puppet.say(reply(1, 42))
                return True

        bus.master._transport = Polled()  # type: ignore[assignment]
        puppet.script = once(POSITION, [])
        assert await bus.read_register("s1", "present_position", raw=True) == 42
        assert len(polls) == 1
        assert bus.stats.counts[Counter.TIMEOUTS] == 0
