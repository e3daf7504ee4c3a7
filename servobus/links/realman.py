"""Through a RealMan arm: Modbus-RTU frames go in and come out, JSON lines travel (ROH seed 2).

To the engine it is a line. One command is under way at a time. The arm's replies say which command they answer and not which
question, so before a question that looks like an earlier one the arm is asked who it is: its answer cannot be mistaken, and
whatever comes before it is dropped. An arm that does not answer at all is left, and called anew.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from servobus.errors import LinkDown
from servobus.links.tcp import CONNECT_TIMEOUT, OPTIONS, explain
from servobus.protocols.base import LineTraits
from servobus.protocols.modbus.codec import BROADCAST, Frame, ModbusCodec
from servobus.protocols.realman import codec
from servobus.protocols.realman.codec import Dialect, Lines, Message, Step
from servobus.protocols.realman.requests import Question

LATENCY = 0.020
"""Seconds an arm takes for one command, at the least."""
HAND_TIMEOUT = 0.1
"""Seconds the arm waits for the hand before it says that it failed; its smallest setting."""
ANSWER_TIMEOUT = 1.0
"""Seconds for the arm's own answers: half of it, and a margin, is what the vendor's client waits beyond the hand's timeout."""
Wanted = Callable[[Message], bool]


class RealmanLink:
    """See `links.base.Link`. `generation` None: the arm is asked. `volts` None: the tool's power is left as it is."""

    def __init__(
        self,
        host: str,
        tcp_port: int,
        baudrate: int,
        *,
        port: int = codec.TOOL,
        generation: int | None = None,
        volts: int | None = None,
    ) -> None:
        where = f"[{host}]" if ":" in host else host
        self.address = f"realman://{where}:{tcp_port}?port={port}"
        self._host = host
        self._tcp_port = tcp_port
        self._baudrate = baudrate
        self._port = port
        self._generation = generation
        self._volts = volts
        self.traits = self._traits(codec.dialect(generation or 2, port))

    def _traits(self, dialect: Dialect) -> LineTraits:
        latency = LATENCY + HAND_TIMEOUT  # a hand that is silent shows as the arm's no, which is worth waiting for
        return LineTraits(
            self._baudrate, latency=latency, turn=2 * LATENCY, max_read=dialect.max_read, max_write=dialect.max_write
        )

    async def connect(self, protocol: asyncio.Protocol) -> RealmanTransport:
        """Raises LinkDown."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                _, arm = await loop.create_connection(
                    lambda: RealmanTransport(protocol, self.address), self._host, self._tcp_port
                )
        except OSError as error:
            raise explain(self.address, error) from None
        try:
            dialect = codec.dialect(await self._who(arm), self._port)
            if self._volts is not None:
                await self._done(arm, codec.set_voltage(self._volts), "does not switch the tool's voltage")
            await self._done(arm, dialect.open_mode(self._baudrate, HAND_TIMEOUT), REFUSED_MODE.format(port=self._port))
        except BaseException:
            arm.abort()
            raise
        self.traits = self._traits(dialect)
        arm.begin(dialect)
        return arm

    async def _who(self, arm: RealmanTransport) -> int:
        """Its generation."""
        for question in (codec.WHO, codec.WHO_2):
            reply = await arm.call(question, codec.is_fence)
            if reply is not None:
                found = codec.generation_of(reply) or 0
                if self._generation not in (None, found):
                    raise LinkDown(f"{self.address}: the arm is of generation {found}: take generation={self._generation} out")
                return found
        raise LinkDown(f"{self.address} does not answer as a RealMan arm does: check host and port (usually 8080)")

    async def _done(self, arm: RealmanTransport, step: Step, problem: str) -> None:
        reply = await arm.call(step.message, step.answers)
        if reply is None or step.words(reply) is None:
            raise LinkDown(f"{self.address}: the arm {problem}")


REFUSED_MODE = (
    "does not make port {port} a Modbus master: switch its gripper or hand mode off, unplug the teach pendant, "
    "and see that no other program has it"
)


class RealmanTransport(asyncio.Protocol):
    """See `links.base.Transport`."""

    def __init__(self, protocol: asyncio.Protocol, address: str) -> None:
        self._protocol = protocol
        self._address = address
        self._loop = asyncio.get_running_loop()
        self._lines = Lines()
        self._socket: asyncio.Transport | None = None
        self._error: LinkDown | None = LinkDown(f"{address} closed the connection: it is opened again")
        self._begun = False
        self._dialect = Dialect(2)
        self._call: tuple[asyncio.Future[Message], Wanted] | None = None
        """Who waits for one reply outside of questions, and what it has to be."""
        self._timer: asyncio.TimerHandle | None = None
        # The question under way
        self._question: Question | None = None
        self._next: Frame | None = None
        """What the engine said while the one before was still under way: that one is not wanted any more."""
        self._step: Step | None = None
        self._fencing = False
        self._looks: set[tuple[str, int]] = set()
        """Of answers since the last fence: another one of that look could be an old one."""
        self._failed: set[str] = set()
        """Commands that failed since then: a no looks the same for any number of values."""

    # Before the line is handed over

    async def call(self, message: Message, wanted: Wanted) -> Message | None:
        """Say it and return the first reply that `wanted` accepts; None: there was none in time."""
        future: asyncio.Future[Message] = self._loop.create_future()
        self._call = (future, wanted)
        self._say(message)
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT):
                return await future
        except TimeoutError:
            return None
        finally:
            self._call = None

    def begin(self, dialect: Dialect) -> None:
        """From here on it is a line."""
        self._dialect = dialect
        self._begun = True
        self._protocol.connection_made(self)  # type: ignore[arg-type]  # a Transport by its methods, not by its base

    # The socket

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._socket = transport  # type: ignore[assignment]  # uvloop's is one by its methods only
        for level, option, value in OPTIONS:
            transport.get_extra_info("socket").setsockopt(level, option, value)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        if self._call is not None and not self._call[0].done():
            self._call[0].set_exception(LinkDown(f"{self._address} closed the connection: is another program on the arm?"))
        if self._error is not None and exc is not None:
            self._error = LinkDown(f"{self._address} was lost ({exc}): it is opened again")
        if self._begun:
            self._protocol.connection_lost(self._error)

    def data_received(self, data: bytes) -> None:
        answer: bytes | None = None
        for message in self._lines.feed(data):
            if self._call is not None:
                future, wanted = self._call
                if not future.done() and wanted(message):
                    future.set_result(message)
            elif (told := self._heard(message)) is not None:
                answer = told
        if answer is not None:  # only now: what else came in one piece with it was no answer to what is asked next
            self._protocol.data_received(answer)

    # Questions

    def write(self, data: bytes) -> None:
        """One Modbus-RTU frame."""
        reader = ModbusCodec("device")
        reader.receive_data(data)
        frame = reader.next_reply()
        if frame is None or frame.unit == BROADCAST or self.is_closing():
            return  # an arm passes on questions to one unit each, and nothing else
        if self._question is not None:
            self._next = frame
            return
        self._ask(frame)

    def _ask(self, frame: Frame) -> None:
        self._question = Question(frame, self._dialect)
        self._go_on()

    def _go_on(self) -> None:
        """The next command of the question, behind a fence where its answer could be an old one."""
        assert self._question is not None
        step = self._question.steps[0]
        self._fencing = step.look in self._looks or step.answer in self._failed
        if self._fencing:
            self._step = None
            self._say(codec.WHO if self._dialect.generation > 2 else codec.WHO_2)
        else:
            self._looks.add(step.look)
            self._step = step
            self._say(step.message)
        self._stop_timer()
        self._timer = self._loop.call_later(ANSWER_TIMEOUT, self._silent)

    def _heard(self, message: Message) -> bytes | None:
        """One line of the arm. Returns the frame to hand over, when the question is answered with it."""
        if self._fencing:
            if codec.is_fence(message):
                self._looks.clear()
                self._failed.clear()
                self._go_on()
            return None
        step, question = self._step, self._question
        if step is None or question is None or not step.answers(message):
            return None  # it speaks of itself, or says something twice
        self._step = None
        self._stop_timer()
        found = step.words(message)
        if found is None:
            self._failed.add(step.answer)
        told = question.take(found)
        if question.steps and self._next is None:
            self._go_on()
            return None
        self._question = None
        if self._next is not None:  # nobody waits for this answer any more
            frame, self._next = self._next, None
            self._ask(frame)
            return None
        return told

    def _silent(self) -> None:
        """No answer at all: whatever comes later on this socket could be taken for another one."""
        self._lose(LinkDown(f"{self._address}: the arm does not answer: it is called again"))

    # The end

    def _say(self, message: Message) -> None:
        if self._socket is not None:
            self._socket.write(codec.encode(message))

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def poll_input(self) -> bool:
        """The loop reads the socket."""
        return False

    def set_baudrate(self, baudrate: int) -> None:
        """Never called: the traits say that it cannot."""

    def is_closing(self) -> bool:
        return self._socket is None or self._socket.is_closing()

    def close(self) -> None:
        """Give the port back to the arm, then leave."""
        step = self._dialect.close_mode() if self._begun else None
        self._error = None
        self._stop_timer()
        if step is not None and not self.is_closing():
            self._say(step.message)
        if self._socket is not None:
            self._socket.close()

    def abort(self) -> None:
        self._lose(None)

    def _lose(self, error: LinkDown | None) -> None:
        self._error = error
        self._stop_timer()
        if self._socket is not None:
            self._socket.abort()
