"""Errors on their way through a door: by the name of their class, with everything they carry, so that they are raised again at
the other end as what they were."""

from __future__ import annotations

import inspect
from typing import Any

from servobus import errors
from servobus.errors import DeviceError, PartialFailure, ServobusError
from servobus.protocols.words import Outcome

PARSE, INVALID_REQUEST, NO_METHOD, INVALID_PARAMS, INTERNAL = -32700, -32600, -32601, -32602, -32603
FAILED = -32000
"""A ServobusError: `data.type` says which."""
TYPES: dict[str, type[ServobusError]] = {
    name: kind for name, kind in vars(errors).items() if inspect.isclass(kind) and issubclass(kind, ServobusError)
}


def encoded(error: ServobusError) -> dict[str, Any]:
    """As JSON-RPC has it: code, message for people, data for programs."""
    data: dict[str, Any] = {"type": type(error).__name__, "message": error.message}
    data |= {key: value for key, value in (("bus", error.bus), ("servo", error.servo), ("raw", error.raw.hex())) if value}
    if isinstance(error, DeviceError) and error.code is not None:
        data["code"] = error.code
    if isinstance(error, PartialFailure):
        data["results"] = {name: _result(result) for name, result in error.results.items()}
    return {"code": FAILED, "message": str(error), "data": data}


def _result(result: Any) -> Any:
    if isinstance(result, ServobusError):
        return {"error": encoded(result)}
    if isinstance(result, BaseException):
        return {"error": {"code": INTERNAL, "message": str(result)}}
    return {"result": result}


def decoded(error: Any) -> Exception:
    """What to raise for the `error` of an answer; whatever it holds, an exception comes out."""
    error = error if isinstance(error, dict) else {}
    message, code, data = str(error.get("message", "no reason given")), error.get("code"), error.get("data")
    if code == INVALID_PARAMS:
        return TypeError(message)
    if not isinstance(data, dict) or not isinstance(data.get("type"), str):
        return ServobusError(f"the daemon could not do it: {message}")
    kind = TYPES.get(data["type"], ServobusError)
    where: dict[str, Any] = {key: str(data[key]) for key in ("bus", "servo") if data.get(key)} | {"raw": _bytes(data.get("raw"))}
    if kind is PartialFailure:
        results = data.get("results")
        return PartialFailure(
            {name: _unresult(one) for name, one in results.items()} if isinstance(results, dict) else {}, **where
        )
    said = str(data.get("message", message))
    if issubclass(kind, DeviceError):
        number = data.get("code")
        return kind(said, code=number if isinstance(number, int) else None, **where)
    return kind(said, **where)


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
