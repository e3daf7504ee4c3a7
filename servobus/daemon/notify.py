"""Messages to systemd (sd_notify): datagrams of KEY=VALUE lines to the socket that it names. Without a socket nothing is sent."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic_ns


class Notifier:
    """`READY=1` once clients can connect, `RELOADING=1`, `STOPPING=1` at the end, `WATCHDOG=1` while every bus makes progress."""

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # @: an abstract socket
        ours = environ.get("WATCHDOG_PID") in (None, "", str(os.getpid()))
        usec = environ.get("WATCHDOG_USEC", "")
        self.watchdog = int(usec) / 1e6 if ours and usec.isdecimal() and int(usec) else None
        """Seconds within which the system expects WATCHDOG=1; None: it does not."""

    def send(self, *lines: str) -> None:
        """Send lines. It never raises: a system that does not listen must not stop a robot."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
            sender.sendto("\n".join(lines).encode(), self._address)

    def ready(self, status: str) -> None:
        self.send("READY=1", f"STATUS={status}")

    def reloading(self) -> None:
        self.send("RELOADING=1", f"MONOTONIC_USEC={monotonic_ns() // 1000}")

    def stopping(self) -> None:
        self.send("STOPPING=1")

    def alive(self) -> None:
        self.send("WATCHDOG=1")
