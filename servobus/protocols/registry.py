"""The protocols there are: one line each. Nothing outside this table and its own folder names a protocol."""

from __future__ import annotations

from servobus.protocols import kst, roh, sms
from servobus.protocols.definition import ProtocolEntry

PROTOCOLS: dict[str, ProtocolEntry] = {
    "sms": sms.ENTRY,
    "kst": kst.ENTRY,
    "roh": roh.ENTRY,
}
