"""The config that `scan --yaml` prints."""

from __future__ import annotations

import json
from collections.abc import Sequence

from servobus.cli.scan import ScanTarget
from servobus.protocols.registry import PROTOCOLS
from servobus.values import ScanHit

HEAD = "# Written by `servobus scan --yaml`. Give the servos names of yours, and limits before anything moves.\n"
BUS = """\
version: 1
buses:
  {bus}:
    protocol: {protocol}
    port: {port}
    baudrate: {rate}
    poll: {{feedback: 20}}
    servos:{servos}
"""


def starter(target: ScanTarget, hits: Sequence[ScanHit]) -> str:
    """A config that `check` accepts, with the servos that answered.

    A line has one baud rate, and a servo needs a model: comments name the servos that are left out for one of these reasons.
    """
    rate = max((hit.baudrate for hit in hits), key=lambda rate: sum(hit.baudrate == rate for hit in hits))
    usable = [hit for hit in hits if hit.baudrate == rate and hit.model]
    notes = [f"# Not in it: id {hit.id} at {hit.baudrate} baud, {_reason(hit, rate)}\n" for hit in hits if hit not in usable]
    servos = "".join(_servos(target.protocol, hit) for hit in usable) or " {}"
    port = json.dumps(target.port)
    return HEAD + "".join(notes) + BUS.format(bus=target.bus, protocol=target.protocol, port=port, rate=rate, servos=servos)


def _servos(protocol: str, hit: ScanHit) -> str:
    servos = PROTOCOLS[protocol].starter(hit.id, hit.model or "").items()
    return "".join(f"\n      {name}: {{{', '.join(f'{key}: {value}' for key, value in keys.items())}}}" for name, keys in servos)


def _reason(hit: ScanHit, rate: int) -> str:
    if hit.baudrate != rate:
        return f"{hit.model or 'unknown model'}: a line has one rate, and most servos here answer at {rate}"
    return f"no model file fits it ({hit.note or hit.product or 'it does not report its model'}): name one, or write your own"
