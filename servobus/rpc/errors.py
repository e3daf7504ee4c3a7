"""Errors as messages: the name of the class and all attributes, so that a client raises what the daemon raised."""

from __future__ import annotations

import functools
import inspect
from typing import Any

from servobus import errors
from servobus.errors import DeviceError, PartialFailure, ServobusError
from servobus.values import Outcome

PARSE, INVALID_REQUEST, NO_METHOD, INVALID_PARAMS, INTERNAL = -32700, -32600, -32601, -32602, -32603
FAILED = -32000
"""A ServobusError: `data.type` says which."""
TYPES: dict[str, type[ServobusError]] = {
    name: kind for name, kind in vars(errors).items() if inspect.isclass(kind) and issubclass(kind, ServobusError)
}


def encoded(error: ServobusError) -> dict[str, Any]:
    """The error as JSON-RPC has it: code, message for people, data for programs."""
    first, *also = _public_kinds(type(error))
    data: dict[str, Any] = {"type": first, "message": error.message} | ({"also": also} if also else {})
    data |= {key: value for key, value in (("bus", error.bus), ("servo", error.servo), ("raw", error.raw.hex())) if value}
    if isinstance(error, DeviceError) and error.code is not None:
        data["code"] = error.code
    if isinstance(error, PartialFailure):
        data["results"] = {name: _result(result) for name, result in error.results.items()}
    return {"code": FAILED, "message": str(error), "data": data}


def _public_kinds(kind: type[ServobusError]) -> list[str]:
    """The most special classes of `errors.py` that the class is or inherits from; a protocol may have finer ones."""
    kinds = [base for base in kind.__mro__ if base in TYPES.values()]
    return [base.__name__ for base in kinds if not any(base is not other and issubclass(other, base) for other in kinds)]


@functools.lru_cache(maxsize=256)
def _kind(first: str, also: tuple[str, ...]) -> type[ServobusError]:
    """The class for the names that `_public_kinds` gave."""
    kinds = [TYPES[name] for name in dict.fromkeys((first, *also)) if name in TYPES] or [ServobusError]
    try:
        return kinds[0] if len(kinds) == 1 else type(kinds[0].__name__, tuple(kinds), {})
    except TypeError:  # these classes cannot be combined
        return kinds[0]


def _result(result: Any) -> Any:
    if isinstance(result, ServobusError):
        return {"error": encoded(result)}
    if isinstance(result, BaseException):
        return {"error": {"code": INTERNAL, "message": str(result)}}
    return {"result": result}


def decoded(error: Any) -> Exception:
    """The exception for the `error` of a reply, whatever it holds."""
    error = error if isinstance(error, dict) else {}
    message, code, data = str(error.get("message", "no reason given")), error.get("code"), error.get("data")
    if code == INVALID_PARAMS:
        return TypeError(message)
    if not isinstance(data, dict) or not isinstance(data.get("type"), str):
        return ServobusError(f"the daemon could not do it: {message}")
    also = data.get("also")
    kind = _kind(data["type"], tuple(also[:8]) if isinstance(also, list) and all(isinstance(name, str) for name in also) else ())
    where: dict[str, Any] = {key: str(data[key]) for key in ("bus", "servo") if data.get(key)} | {"raw": _bytes(data.get("raw"))}
    if issubclass(kind, PartialFailure):
        results = data["results"] if isinstance(data.get("results"), dict) else {}
        return PartialFailure({name: _unresult(one) for name, one in results.items()}, **where)
    text = str(data.get("message", message))
    if issubclass(kind, DeviceError):
        number = data.get("code")
        return kind(text, code=number if isinstance(number, int) else None, **where)
    return kind(text, **where)


def _bytes(text: Any) -> bytes:
    try:
        return bytes.fromhex(text or "")
    except (TypeError, ValueError):
        return b""


def _unresult(result: Any) -> Any:
    if isinstance(result, dict) and "error" in result:
        return decoded(result["error"])
    value = result.get("result") if isinstance(result, dict) else result
    return Outcome(value) if isinstance(value, str) and value in set(Outcome) else value
