"""The config that `scan --yaml` prints."""

from __future__ import annotations

import io
from collections.abc import Sequence

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from servobus.cli.scan import ScanTarget
from servobus.protocols.registry import PROTOCOLS
from servobus.values import ScanHit

HEAD = "# Written by `servobus scan --yaml`. Give the servos names of yours, and limits before anything moves.\n"


def starter(target: ScanTarget, hits: Sequence[ScanHit]) -> str:
    """A config that `check` accepts, with the servos that answered.

    A line has one baud rate, and a servo needs a model: comments name the servos that are left out for one of these reasons.
    """
    rate = max((hit.baudrate for hit in hits), key=lambda rate: sum(hit.baudrate == rate for hit in hits))
    usable = [hit for hit in hits if hit.baudrate == rate and hit.model]
    notes = "".join(
        f"# Not in it: id {hit.id} at {hit.baudrate} baud, {_reason(hit, rate)}\n" for hit in hits if hit not in usable
    )
    text = io.StringIO()
    YAML().dump(_document(target, usable, rate), text)
    return f"{HEAD}{notes}{text.getvalue()}"


def _document(target: ScanTarget, hits: Sequence[ScanHit], rate: int) -> CommentedMap:
    write = PROTOCOLS[target.protocol].starter
    servos = CommentedMap((servo, CommentedMap(keys)) for hit in hits for servo, keys in write(hit.id, hit.model or "").items())
    poll = CommentedMap(feedback=20)
    for part in (poll, *(servos.values() or [servos])):
        part.fa.set_flow_style()
    bus = CommentedMap(protocol=target.protocol, port=target.port, baudrate=rate, poll=poll, servos=servos)
    return CommentedMap(version=1, buses=CommentedMap({target.bus: bus}))


def _reason(hit: ScanHit, rate: int) -> str:
    if hit.baudrate != rate:
        return f"{hit.model or 'unknown model'}: a line has one rate, and most servos here answer at {rate}"
    return f"no model file fits it ({hit.note or hit.product or 'it does not say who it is'}): name one, or write your own"
