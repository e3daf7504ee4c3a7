"""Lines into calls: framing, JSON within limits, calls and their parameters. Pure.

A line is checked for its depth, and for a key that is in one object twice, because two readers could understand two things.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import msgspec

from servobus.errors import ServobusError
from servobus.rpc.errors import INTERNAL, INVALID_PARAMS, INVALID_REQUEST, NO_METHOD, PARSE, encoded
from servobus.rpc.methods import MAX_BATCH, MAX_DEPTH, MAX_LINE, METHODS, Params

STRING = re.compile(rb'"(?:[^"\\]|\\.)*"')
STEP = {ord("{"): 1, ord("["): 1, ord("}"): -1, ord("]"): -1}
encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder().decode
URGENT = frozenset({"stop", "renew", "cancel"})  # methods that do not wait for earlier calls
_urgent = re.compile(rb'"(?:%b)"' % b"|".join(name.encode() for name in sorted(URGENT)))
NO_ID = object()  # the id of a notification, which gets no reply


class Refused(Exception):
    """A message is wrong: JSON-RPC's code and the reason."""

    def __init__(self, code: int, message: str, call_id: Any = None) -> None:
        super().__init__(message)
        self.code = code
        self.call_id = call_id

    def reply(self) -> bytes:
        return failed(self.call_id, {"code": self.code, "message": str(self)})


@dataclass(slots=True)
class Call:
    """One request or notification."""

    method: str
    params: Params
    id: Any

    @property
    def wants_reply(self) -> bool:
        return self.id is not NO_ID


class _Head(msgspec.Struct):
    method: Any = None


_heads = msgspec.json.Decoder(_Head | list[_Head]).decode


def urgent(line: bytes) -> set[str]:
    """The urgent methods that a line calls. The line is not checked otherwise, and may still be refused."""
    if not _urgent.search(line):
        return set()
    try:
        heads = _heads(line)
    except (ValueError, RecursionError):
        return set()  # it is refused when its turn comes
    called = [head.method for head in (heads if isinstance(heads, list) else [heads])]  # of any type yet
    return {name for name in URGENT if name in called}


class Framer:
    """Cuts a stream into lines; keeps at most one line in memory."""

    def __init__(self, limit: int = MAX_LINE) -> None:
        self._buffer = b""
        self._limit = limit

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes, and return the lines that are complete. Raises Refused for a line that is too long."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        if len(self._buffer) >= self._limit or any(len(line) >= self._limit for line in lines):
            raise Refused(INVALID_REQUEST, f"a line has at most {self._limit} bytes")
        return lines


def parse(line: bytes) -> list[Any]:
    """The messages of a line, not checked yet. Raises Refused."""
    bare = STRING.sub(b"", line)
    opened = bare.count(b"{") + bare.count(b"[")
    if opened > MAX_DEPTH and max(accumulate(STEP.get(byte, 0) for byte in bare)) > MAX_DEPTH:
        raise Refused(PARSE, f"more than {MAX_DEPTH} levels deep")
    try:
        message = _decode(line)
    except (ValueError, RecursionError):
        raise Refused(PARSE, "this is not JSON: send one object, or an array of them, in a line") from None
    if bare.count(b":") != _keys(message):
        raise Refused(PARSE, "a key is in one object twice: give it once")
    if not isinstance(message, list):
        return [message]
    if not 1 <= len(message) <= MAX_BATCH:
        raise Refused(INVALID_REQUEST, f"a batch has 1 to {MAX_BATCH} calls")
    return message


def _keys(value: Any) -> int:
    if isinstance(value, dict):
        return len(value) + sum(map(_keys, value.values()))
    return sum(map(_keys, value)) if isinstance(value, list) else 0


def call_of(message: Any) -> Call:
    """The call of a message. Raises Refused, with the id of the call where there is one."""
    if not isinstance(message, dict):
        raise Refused(INVALID_REQUEST, "a call is an object with jsonrpc, method, params and id")
    call_id = message.get("id", NO_ID)
    if call_id is not NO_ID and (isinstance(call_id, bool) or not isinstance(call_id, (str, int, float, type(None)))):
        raise Refused(INVALID_REQUEST, "an id is a string, a number or null")
    reply_id = None if call_id is NO_ID else call_id
    if message.get("jsonrpc") != "2.0" or message.keys() - {"jsonrpc", "method", "params", "id"}:
        form = '{"jsonrpc":"2.0","method":...,"params":{...},"id":...}'
        raise Refused(INVALID_REQUEST, f"a call is {form} and nothing else", reply_id)
    name = message.get("method")
    method = METHODS.get(name) if isinstance(name, str) else None
    if method is None or not isinstance(name, str):
        raise Refused(NO_METHOD, f"no such method; there are {', '.join(METHODS)}", reply_id)
    return Call(name, _params(method.params, message.get("params", {}), reply_id), call_id)


def _params(kind: type[Params], values: Any, reply_id: Any) -> Params:
    fields = kind.__struct_fields__
    listing = ", ".join(fields) or "none"
    if isinstance(values, list):
        if len(values) > len(fields):
            raise Refused(INVALID_PARAMS, f"params: at most {listing}", reply_id)
        values = dict(zip(fields, values, strict=False))
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise Refused(INVALID_PARAMS, f"params: {error}; there are {listing}", reply_id) from None


def success(call_id: Any, result: Any) -> bytes:
    return b'{"jsonrpc":"2.0","id":%b,"result":%b}' % (encode(call_id), encode(result))


def failed(call_id: Any, error: dict[str, Any]) -> bytes:
    return b'{"jsonrpc":"2.0","id":%b,"error":%b}' % (encode(call_id), encode(error))


def failure(call_id: Any, error: BaseException) -> bytes:
    """The reply for an error that a call raised."""
    if isinstance(error, ServobusError):
        return failed(call_id, encoded(error))
    if isinstance(error, (ValueError, TypeError)):
        return failed(call_id, {"code": INVALID_PARAMS, "message": str(error)})
    return failed(call_id, {"code": INTERNAL, "message": "internal error of the daemon: its log says more"})


def notification(method: str, params: bytes) -> bytes:
    """`params` is JSON already."""
    return b'{"jsonrpc":"2.0","method":%b,"params":%b}\n' % (encode(method), params)
