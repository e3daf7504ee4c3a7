"""Every frame that the SMS 1.0 document prints, by its section: requests, and the replies to them."""

from __future__ import annotations

from typing import Any

from servobus.protocols.base import Request
from servobus.protocols.sms.requests import Action, Ping, Read, RegWrite, Reset, SyncWrite, Write

GOAL = bytes.fromhex("00 08 00 00 E8 03")
"""Position 2048, time 0, speed 1000."""

REQUESTS: dict[str, tuple[Request[Any], str]] = {
    "1.3.1 ping 1": (Ping(1), "FF FF 01 02 01 FB"),
    "1.3.2 read position of 1": (Read(1, 0x38, 2, bytes), "FF FF 01 04 02 38 02 BE"),
    "1.3.3 every id becomes 1": (Write(0xFE, 5, b"\x01"), "FF FF FE 04 03 05 01 F4"),
    "1.3.3 move 1": (Write(1, 0x2A, GOAL), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
    **{
        f"1.3.4 arm {servo}": (RegWrite(servo, 0x2A, GOAL), f"FF FF {servo:02X} 09 04 2A 00 08 00 00 E8 03 {0xD5 - servo:02X}")
        for servo in range(1, 11)
    },
    "1.3.5 action": (Action(), "FF FF FE 02 05 FA"),
    "1.4.5 move 1 to 4": (
        SyncWrite(0x2A, dict.fromkeys((1, 2, 3, 4), GOAL)),
        "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 03 00 08 00 00 E8 03 04 00 08 00 00 E8 03 58",
    ),
    "1.4.6 reset 1": (Reset(1), "FF FF 01 02 06 F6"),
    "1.4.6 reset 0": (Reset(0), "FF FF 00 02 06 F7"),
}

REPLIES: dict[str, tuple[Request[Any], str, object]] = {
    "1.3.1": (Ping(1), "FF FF 01 02 00 FC", 0),
    "1.3.2": (Read(1, 0x38, 2, lambda data: int.from_bytes(data, "little")), "FF FF 01 04 00 18 05 DD", 1304),
    "1.3.3": (Write(1, 0x2A, GOAL), "FF FF 01 02 00 FC", 0),
    "1.3.4": (RegWrite(1, 0x2A, GOAL), "FF FF 01 02 00 FC", 0),
    "1.4.6 from 1": (Reset(1), "FF FF 01 02 00 FC", 0),
    "1.4.6 from 0, now 1": (Reset(0), "FF FF 01 02 00 FC", 0),
}
