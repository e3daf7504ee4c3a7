"""Serial links with full buffers, closed from either side; over real PTYs."""

from __future__ import annotations

import fcntl
from collections.abc import Callable

import pytest

from servobus.errors import LinkDown
from servobus.links.serial import MAX_UNSENT, DirectTransport, SerialLink
from tests.links.bare_pty import Pty, plugged
from tests.links.recorder import Receiver, on_each_loop


async def filled(pty: Pty, receiver: Receiver) -> tuple[DirectTransport, bytes]:
    """A transport whose kernel buffer is full, and all that it was given so far."""
    transport = await SerialLink(pty.path, 1_000_000).connect(receiver)
    sent = b""
    while not transport.get_write_buffer_size():
        chunk = bytes(at & 0xFF for at in range(len(sent), len(sent) + 1021))
        transport.write(chunk)
        sent += chunk
    return transport, sent


@on_each_loop
async def test_what_finds_no_room_goes_later() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport, sent = await filled(pty, receiver)
        transport.write(b"the end")
        assert await pty.receive(len(sent) + 7) == sent + b"the end"
        assert transport.get_write_buffer_size() == 0
        transport.write(b"at once")
        assert await pty.receive(7) == b"at once"
        transport.abort()
        assert await receiver.gone() is None


async def test_what_waits_for_room_is_bounded() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport, _ = await filled(pty, receiver)
        transport.write(bytes(MAX_UNSENT - transport.get_write_buffer_size()))
        assert not transport.is_closing()
        transport.write(b"x")
        assert transport.is_closing()
        error = await receiver.gone()
        assert isinstance(error, LinkDown)
        assert "takes no more bytes" in str(error)


@on_each_loop
async def test_a_close_sends_everything() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport, sent = await filled(pty, receiver)
        transport.close()
        transport.write(b"too late")
        assert transport.is_closing()
        assert await pty.receive(len(sent)) == sent
        assert await receiver.gone() is None
        assert pty.received() == b""


@on_each_loop
async def test_who_aborts_waits_for_nothing() -> None:
    """The other side takes nothing, and never will."""
    receiver = Receiver()
    with plugged() as pty:
        transport, _ = await filled(pty, receiver)
        transport.close()
        transport.abort()
        transport.abort()
        assert await receiver.gone() is None
        transport.close()
        transport.abort()
        transport.set_baudrate(9_600)
        assert await receiver.gone() is None


@on_each_loop
async def test_unplugged() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 115_200).connect(receiver)
        pty.unplug()
        error = await receiver.gone()
        assert isinstance(error, LinkDown)
        assert str(error).startswith(f"{pty.path} was unplugged, or its other end closed: it is opened again when it is back")
        transport.write(b"nobody")
        assert (transport.is_closing(), receiver.lost) == (True, [error])


@pytest.mark.parametrize("verb", ["write", "poll_input", "set_baudrate"])
async def test_unplugged_as_the_next_call_finds_out(verb: str) -> None:
    """Reported once, though the loop finds it out as well; and not from within the call."""
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 115_200).connect(receiver)
        pty.unplug()
        calls: dict[str, Callable[[], object]] = {
            "write": lambda: transport.write(b"x"),
            "poll_input": transport.poll_input,
            "set_baudrate": lambda: transport.set_baudrate(9_600),
        }
        calls[verb]()
        assert (transport.is_closing(), receiver.lost) == (True, [])
        assert isinstance(await receiver.gone(), LinkDown)


@on_each_loop
async def test_unplugged_with_a_full_buffer() -> None:
    receiver = Receiver()
    with plugged() as pty:
        await filled(pty, receiver)
        pty.unplug()
        assert isinstance(await receiver.gone(), LinkDown)


@on_each_loop
async def test_unplugged_while_closing() -> None:
    """A link that was closing ends without an error."""
    receiver = Receiver()
    with plugged() as pty:
        transport, _ = await filled(pty, receiver)
        transport.close()
        pty.unplug()
        assert await receiver.gone() is None


async def test_the_port_is_free_when_the_loss_is_reported() -> None:
    """The next user can open it, because the exclusive lock is released."""
    with plugged() as pty:
        for leave in ("close", "abort"):
            receiver = Receiver()
            transport = await SerialLink(pty.path, 115_200).connect(receiver)
            getattr(transport, leave)()
            assert await receiver.gone() is None
            fcntl.flock(pty.slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.flock(pty.slave, fcntl.LOCK_UN)
