"""The protocols, one line each. Only this table and a protocol's own package name the protocol."""

from __future__ import annotations

from servobus.protocols import kst, roh, sms
from servobus.protocols.definition import ProtocolDefinition

PROTOCOLS: dict[str, ProtocolDefinition] = {
    "sms": sms.DEFINITION,
    "kst": kst.DEFINITION,
    "roh": roh.DEFINITION,
}
