"""A RealMan arm as a line: Modbus-RTU frames go in and come out, and JSON lines travel (RealMan JSON).

One command is in flight at a time. A reply of the arm names the command that it answers, but not the request. How a late reply is
kept from being taken for a later one:

* A command may be sent if no reply since the last fence can be confused with its own (`ArmCommand.reply_key`), and no command of
  that name failed since then, for all failures of a command look the same.
* Otherwise a fence is sent first: the arm is asked for its software version. Everything before that reply is discarded.
* If the arm does not answer at all, the connection is closed, and the supervisor opens another one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from servobus.errors import LinkDown
from servobus.links.tcp import CONNECT_TIMEOUT, SocketTransport, explain_connect_error
from servobus.protocols.base import LineTraits
from servobus.protocols.modbus.codec import BROADCAST, Frame, ModbusCodec
from servobus.protocols.realman import codec
from servobus.protocols.realman.codec import ArmCommand, Dialect, JsonLines, Message
from servobus.protocols.realman.requests import TunnelRequest

LATENCY = 0.020
"""Seconds an arm takes for one command, at the least."""
HAND_TIMEOUT = 0.1
"""Seconds the arm waits for the hand before it reports a failure; its smallest setting."""
ANSWER_TIMEOUT = 1.0
"""Seconds the arm gets for its own replies. The vendor's client waits about 0.5 s beyond the hand's timeout."""
Accept = Callable[[Message], bool]


class RealmanLink:
    """The address of an arm; see `links.base.Link`."""

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
        """`generation`: None asks the arm. `volts`: the supply at the tool; None leaves it as it is."""
        netloc = f"[{host}]" if ":" in host else host
        self.address = f"realman://{netloc}:{tcp_port}?port={port}"
        self._host = host
        self._tcp_port = tcp_port
        self._baudrate = baudrate
        self._port = port
        self._generation = generation
        self._volts = volts
        self.traits = self._traits(codec.dialect(generation or 2, port))

    def _traits(self, dialect: Dialect) -> LineTraits:
        latency = LATENCY + HAND_TIMEOUT  # the arm reports a hand that is silent, and that report is waited for
        return LineTraits(
            self._baudrate, latency=latency, turn=2 * LATENCY, max_read=dialect.max_read, max_write=dialect.max_write
        )

    async def connect(self, protocol: asyncio.Protocol) -> RealmanTransport:
        """Connect, ask for the generation, and make the port a Modbus master. Raises LinkDown."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                _, arm = await loop.create_connection(
                    lambda: RealmanTransport(protocol, self.address), self._host, self._tcp_port
                )
        except OSError as error:
            raise explain_connect_error(self.address, error) from None
        try:
            dialect = codec.dialect(await self._ask_generation(arm), self._port)
            if self._volts is not None:
                await self._command(arm, codec.set_voltage(self._volts), "does not switch the tool's voltage")
            await self._command(arm, dialect.open_mode(self._baudrate, HAND_TIMEOUT), MODE_REFUSED.format(port=self._port))
        except BaseException:
            arm.abort()
            raise
        self.traits = self._traits(dialect)
        arm.begin(dialect)
        return arm

    async def _ask_generation(self, arm: RealmanTransport) -> int:
        for question in (codec.INFO, codec.VERSION):
            reply = await arm.call(question, codec.is_fence)
            if reply is not None:
                generation = codec.generation_of(reply) or 0
                if self._generation not in (None, generation):
                    raise LinkDown(
                        f"{self.address}: the arm is of generation {generation}: take generation={self._generation} out"
                    )
                return generation
        raise LinkDown(f"{self.address} does not answer as a RealMan arm does: check host and port (usually 8080)")

    async def _command(self, arm: RealmanTransport, command: ArmCommand, problem: str) -> None:
        reply = await arm.call(command.message, command.answers)
        if reply is None or command.registers(reply) is None:
            raise LinkDown(f"{self.address}: the arm {problem}")


MODE_REFUSED = (
    "does not make port {port} a Modbus master: switch its gripper or hand mode off, unplug the teach pendant, "
    "and see that no other program has it"
)


class RealmanTransport(SocketTransport):
    """An open connection to an arm; see `links.base.Transport`."""

    def __init__(self, protocol: asyncio.Protocol, address: str) -> None:
        super().__init__(protocol, address)
        self._loop = asyncio.get_running_loop()
        self._lines = JsonLines()
        self._begun = False
        self._dialect = Dialect(2)
        self._call: tuple[asyncio.Future[Message], Accept] | None = None
        """The caller of `call`, and which reply it accepts."""
        self._timer: asyncio.TimerHandle | None = None
        self._request: TunnelRequest | None = None
        """The Modbus request in flight."""
        self._next: Frame | None = None
        """A request that the engine sent while another one was in flight: it has given that one up."""
        self._command: ArmCommand | None = None
        """The command in flight; None while a fence is."""
        self._fencing = False
        self._keys: set[tuple[str, int]] = set()
        """Reply keys of the commands sent since the last fence."""
        self._failed: set[str] = set()
        """Names of the commands that failed since then."""

    # Before the line is handed over

    async def call(self, message: Message, accept: Accept) -> Message | None:
        """Send a message and return the first reply that `accept` takes; None if there is none in time."""
        future: asyncio.Future[Message] = self._loop.create_future()
        self._call = (future, accept)
        self._send(message)
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT):
                return await future
        except TimeoutError:
            return None
        finally:
            self._call = None

    def begin(self, dialect: Dialect) -> None:
        """Hand the line to the protocol that was passed to `connect`."""
        self._dialect = dialect
        self._begun = True
        self._protocol.connection_made(self)  # type: ignore[arg-type]  # has a transport's methods, but not its base class

    # The socket

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        if self._call is not None and not self._call[0].done():
            self._call[0].set_exception(LinkDown(f"{self._address} closed the connection: is another program on the arm?"))
        if self._begun:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Pass the Modbus reply on after all lines of this chunk: none of them can answer what the engine sends next."""
        reply: bytes | None = None
        for message in self._lines.feed(data):
            if self._call is not None:
                future, accept = self._call
                if not future.done() and accept(message):
                    future.set_result(message)
            else:
                reply = self._on_message(message) or reply
        if reply is not None:
            self._protocol.data_received(reply)

    # Requests

    def write(self, data: bytes) -> None:
        """Take one Modbus-RTU frame. Ignores broadcasts and other bytes, which an arm cannot pass on."""
        reader = ModbusCodec("device")
        reader.receive_data(data)
        frame = reader.next_reply()
        if frame is None or frame.unit == BROADCAST or self.is_closing():
            return
        if self._request is not None:
            self._next = frame
            return
        self._begin_request(frame)

    def _begin_request(self, frame: Frame) -> None:
        self._request = TunnelRequest(frame, self._dialect)
        self._send_command()

    def _send_command(self) -> None:
        """Send the next command of the request, or a fence where its reply could be confused with an earlier one."""
        assert self._request is not None
        command = self._request.commands[0]
        self._fencing = command.reply_key in self._keys or command.reply_name in self._failed
        if self._fencing:
            self._command = None
            self._send(codec.INFO if self._dialect.generation > 2 else codec.VERSION)
        else:
            self._keys.add(command.reply_key)
            self._command = command
            self._send(command.message)
        self._stop_timer()
        self._timer = self._loop.call_later(ANSWER_TIMEOUT, self._on_silence)

    def _on_message(self, message: Message) -> bytes | None:
        """Take one line of the arm. Returns the Modbus reply when it completes the request."""
        if self._fencing:
            if codec.is_fence(message):
                self._keys.clear()
                self._failed.clear()
                self._send_command()
            return None
        command, request = self._command, self._request
        if command is None or request is None or not command.answers(message):
            return None  # unsolicited, or a duplicate
        self._command = None
        self._stop_timer()
        registers = command.registers(message)
        if registers is None:
            self._failed.add(command.reply_name)
        reply = request.take(registers)
        if request.commands and self._next is None:
            self._send_command()
            return None
        self._request = None
        if self._next is not None:  # the engine has given this request up
            frame, self._next = self._next, None
            self._begin_request(frame)
            return None
        return reply

    def _on_silence(self) -> None:
        """Close the connection: a reply that arrives on it from now on could be taken for another one."""
        self.lose(LinkDown(f"{self._address}: the arm does not answer: the connection is opened again"))

    # The end

    def _send(self, message: Message) -> None:
        self._socket.write(codec.encode(message))

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def close(self) -> None:
        """Give the port back to the arm, then close."""
        command = self._dialect.close_mode() if self._begun else None
        self._stop_timer()
        if command is not None and not self.is_closing():
            self._send(command.message)
        super().close()

    def lose(self, error: LinkDown | None) -> None:
        self._stop_timer()
        super().lose(error)
