"""The simulated line: which replies come, how long bytes take, and collisions. In virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, closing

import pytest

from servobus.protocols.sms.codec import BROADCAST_ID, Instruction, SmsCodec, encode
from servobus.protocols.sms.model import packaged_models
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.simulation.line import SimulatedLine, blend, overlay
from tests.virtual_time import virtual

PING = encode(1, Instruction.PING)
ACK = encode(1, 0)
SLOW = 4800
"""Another rate; one byte takes about 2 ms."""
BYTE = 10e-6
"""Seconds of a byte at 1 Mbaud."""


class Listener:
    """The master's ear."""

    def __init__(self, line: SimulatedLine) -> None:
        self.received: list[bytes] = []
        self.times: list[float] = []
        """When each piece was heard, in seconds since it began to listen."""
        self._news = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._start = self._loop.time()
        self.line = line
        line.attach(self._deliver)

    def _deliver(self, data: bytes) -> None:
        self.received.append(data)
        self.times.append(self._loop.time() - self._start)
        self._news.set()

    def send(self, *parts: bytes) -> None:
        for part in parts:
            self.line.receive(part)

    async def until(self, count: int) -> list[bytes]:
        async with asyncio.timeout(10):
            while len(self.received) < count:
                self._news.clear()
                await self._news.wait()
        return self.received


def servo(servo_id: int = 1, position: int = 2048, baudrate: int = 1_000_000, return_delay: int = 0) -> SmsDevice:
    device = SmsDevice(packaged_models()["sts"], servo_id, baudrate=baudrate, position=position)
    device.memory.store(device.memory.registers["return_delay"], return_delay)
    return device


def read_position(servo_id: int = 1) -> bytes:
    return encode(servo_id, Instruction.READ, b"\x38\x02")


def position_of(servo_id: int, position: int) -> bytes:
    return encode(servo_id, 0, position.to_bytes(2, "little"))


@asynccontextmanager
async def connected(
    devices: Sequence[SmsDevice], *, baudrate: int = 1_000_000, wire_time: bool = True
) -> AsyncIterator[Listener]:
    loop = asyncio.get_running_loop()
    with closing(SimulatedLine(devices, SmsCodec(), loop, baudrate=baudrate, wire_time=wire_time)) as line:
        yield Listener(line)


@pytest.fixture(params=[True, False], ids=["wire time", "no wire time"])
def wire_time(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@virtual
async def test_a_reply_comes_later_and_whole(wire_time: bool) -> None:
    """Never from within `receive`, and in one piece, also when the request came byte by byte."""
    async with connected([servo()], wire_time=wire_time) as master:
        master.send(*(bytes((byte,)) for byte in PING))
        assert master.received == []
        assert await master.until(1) == [ACK]


@virtual
async def test_bytes_take_their_time() -> None:
    """A reply is there when request, return delay and reply are over."""
    prompt, slow = servo(1), servo(2, return_delay=50)
    async with connected([prompt, slow]) as master:
        master.send(PING)
        await master.until(1)
        assert master.times == [pytest.approx(12 * BYTE)]
        master.send(encode(2, Instruction.READ, b"\x38\x02"))
        await master.until(2)
        assert master.times[1] - master.times[0] == pytest.approx(16 * BYTE + 100e-6)


@virtual
async def test_bytes_of_a_slow_line_take_longer() -> None:
    """In the proportion of the rates, to the byte."""
    async with connected([servo(baudrate=SLOW)], baudrate=SLOW) as master:
        master.send(PING)
        await master.until(1)
        assert master.times == [pytest.approx(12 * 10 / SLOW)]


@virtual
async def test_pieces_of_a_request_queue_up() -> None:
    """A byte written while another is being sent follows it without a gap."""
    async with connected([servo()]) as master:
        master.send(*(bytes((byte,)) for byte in PING))
        await master.until(1)
        assert master.times == [pytest.approx(12 * BYTE)]


@virtual
async def test_the_backlog_is_the_time_of_unsent_bytes() -> None:
    """In seconds; 0 once everything is sent."""
    async with connected([servo()]) as master:
        assert master.line.backlog() == 0
        master.send(bytes(60) + PING)
        assert master.line.backlog() == pytest.approx(66 * BYTE)
        await master.until(1)
        assert master.line.backlog() == 0


@virtual
async def test_without_wire_time_nothing_takes_time() -> None:
    """Neither bytes nor return delay."""
    async with connected([servo(return_delay=250)], wire_time=False) as master:
        master.send(PING)
        await master.until(1)
        assert master.times == [0.0]


@virtual
async def test_the_next_frame_queues_behind_a_broadcast(wire_time: bool) -> None:
    """A broadcast has no answer to wait for, so two frames in one go are both obeyed."""
    write = encode(BROADCAST_ID, Instruction.WRITE, b"\x2e\x07\x00")
    async with connected([servo()], wire_time=wire_time) as master:
        master.send(write + encode(1, Instruction.READ, b"\x2e\x01"))
        assert await master.until(1) == [encode(1, 0, b"\x07")]
        assert master.line.collisions == 0


@pytest.mark.parametrize("parts", [(PING + read_position(2),), (PING, read_position(2))], ids=["one write", "two writes"])
@virtual
async def test_a_master_that_does_not_wait_is_drowned(parts: tuple[bytes, ...]) -> None:
    """The AND of both arrives as the reply, and no device receives the second request."""
    async with connected([servo(1, baudrate=SLOW), servo(2, baudrate=SLOW)], baudrate=SLOW) as master:
        master.send(*parts)
        assert await master.until(1) == [overlay(ACK, read_position(2), 0)]
        assert master.line.collisions == 1
        master.send(PING)
        assert (await master.until(2))[1:] == [ACK]


@virtual
async def test_two_servos_of_one_id_speak_at_once(wire_time: bool) -> None:
    """Their bytes are ANDed, and it is counted."""
    async with connected([servo(position=0x0F3), servo(position=0x33F)], wire_time=wire_time) as master:
        master.send(read_position())
        garbled = bytes(a & b for a, b in zip(position_of(1, 0x0F3), position_of(1, 0x33F), strict=True))
        assert await master.until(1) == [garbled]
        assert master.line.collisions == 1


@virtual
async def test_replies_that_overlap_in_part_are_one() -> None:
    """A second servo of that id replies some bytes later: the master receives one long piece."""
    async with connected([servo(), servo(return_delay=50)]) as master:
        master.send(encode(1, Instruction.READ, b"\x80\x14"))
        reply = encode(1, 0, bytes(20))
        assert await master.until(1) == [blend(reply, reply, 10)]
        assert len(master.received[0]) == len(reply) + 10


@virtual
async def test_replies_that_do_not_overlap_are_two() -> None:
    """A later reply of another servo with the same id is no collision."""
    async with connected([servo(), servo(return_delay=50)]) as master:
        master.send(PING)
        assert await master.until(2) == [ACK, ACK]
        assert master.line.collisions == 0


@virtual
async def test_sync_read_answers_one_after_another(wire_time: bool) -> None:
    """In the order of the request, whatever the order of the devices; a missing one delays no other."""
    async with connected([servo(node, node * 100) for node in (3, 1, 2)], wire_time=wire_time) as master:
        master.send(encode(BROADCAST_ID, Instruction.SYNC_READ, bytes((0x38, 2, 2, 9, 1, 3))))
        assert await master.until(3) == [position_of(node, node * 100) for node in (2, 1, 3)]
        assert master.line.collisions == 0


@virtual
async def test_a_servo_hears_only_its_own_rate(wire_time: bool) -> None:
    """Within 3 %."""
    devices = [servo(1, baudrate=500_000), servo(2, baudrate=1_000_000), servo(3, baudrate=1_020_000)]
    async with connected(devices, wire_time=wire_time) as master:
        master.send(PING, encode(2, Instruction.PING))
        assert await master.until(1) == [encode(2, 0)]
        master.send(encode(3, Instruction.PING))
        await master.until(2)
        master.line.set_baudrate(500_000)
        master.send(PING)
        assert (await master.until(3))[2] == ACK


@virtual
async def test_another_rate_ends_what_was_being_sent() -> None:
    """Half a request, and a reply on its way, are lost; the same rate again loses nothing."""
    async with connected([servo(1), servo(2, baudrate=SLOW)]) as master:
        master.send(PING)
        master.line.set_baudrate(SLOW)
        master.send(PING[:3])
        master.line.set_baudrate(1_000_000)
        master.line.set_baudrate(SLOW)
        master.send(PING[3:] + encode(2, Instruction.PING))
        master.line.set_baudrate(SLOW)
        assert await master.until(1) == [encode(2, 0)]


@virtual
async def test_a_late_reply_comes_after_others(wire_time: bool) -> None:
    """The delay of a fault counts with and without wire time."""
    slow, quick = servo(1), servo(2)
    slow.extra_delay = 0.02
    async with connected([slow, quick], wire_time=wire_time) as master:
        master.send(PING, encode(2, Instruction.PING))
        assert await master.until(2) == [encode(2, 0), ACK]
        assert master.line.collisions == 0


@virtual
async def test_devices_can_be_reached_into(wire_time: bool) -> None:
    """A dead servo is silent, a servo added to the line answers."""
    device = servo(1)
    async with connected([device], wire_time=wire_time) as master:
        device.dead = True
        master.line.devices.append(servo(2))
        master.send(PING)
        master.send(encode(2, Instruction.PING))
        assert await master.until(1) == [encode(2, 0)]


@virtual
async def test_a_closed_line_is_silent(wire_time: bool) -> None:
    """Neither what was on its way nor what is asked later is answered; closing twice is allowed."""
    async with connected([servo()], wire_time=wire_time) as other, connected([servo()], wire_time=wire_time) as master:
        other.send(PING)
        other.line.close()
        other.send(PING)
        master.send(PING)
        await master.until(1)
        assert other.received == []


@virtual
async def test_a_line_nobody_listens_to_goes_on() -> None:
    """What is sent before a master is attached is lost."""
    line = SimulatedLine([servo()], SmsCodec(), asyncio.get_running_loop(), baudrate=1_000_000, wire_time=False)
    line.receive(PING)
    await asyncio.sleep(0)
    master = Listener(line)
    master.send(PING)
    assert await master.until(1) == [ACK]
    line.close()


def test_bytes_that_meet_are_anded() -> None:
    """And a silent line is all ones."""
    assert overlay(b"\xff\xf0\xff", b"\x0f\x3c", 1) == b"\xff\x00\x3c"
    assert overlay(b"\xff\xf0", b"\x00\x3c\x00", -1) == b"\x3c\x00"
    assert blend(b"\x01", b"\x02", 2) == b"\x01\xff\x02"
    assert blend(b"\x0f\x0f\x0f", b"\x3c", 1) == b"\x0f\x0c\x0f"
