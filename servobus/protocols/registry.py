"""The protocols there are: one line each. Nothing outside this table and its own folder names a protocol."""

from __future__ import annotations

from servobus.protocols import kst, roh, sms
from servobus.protocols.definition import ProtocolDefinition

PROTOCOLS: dict[str, ProtocolDefinition] = {
    "sms": sms.DEFINITION,
    "kst": kst.DEFINITION,
    "roh": roh.DEFINITION,
}
