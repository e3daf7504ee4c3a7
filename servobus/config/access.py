"""Who may come in through a door, and as what: roles, and the YAML keys `access` and `door`.

A role can do what the roles before it can. Who is what on a Unix socket follows from the credentials the system gives of the
other end; through TCP, from the token.
"""

from __future__ import annotations

import grp
import ipaddress
import os
import pwd
from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from servobus.protocols.model import Data
from servobus.values import Role

__all__ = ["AccessOptions", "DoorOptions", "Role", "TcpOptions", "TlsOptions"]

PATTERN = r"^@?[A-Za-z_][A-Za-z0-9_.-]{0,31}\$?$"


Who = Annotated[str, Field(pattern=PATTERN)]


Users = Annotated[tuple[Who, ...], Field(strict=False)]
"""YAML has lists."""


class AccessOptions(Data):
    """Users, or groups as `@name`. Nothing given: the owner of the daemon and root are admin, all others observer."""

    admin: Users = ()
    operator: Users = ()

    @field_validator("admin", "operator")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            try:
                grp.getgrnam(name[1:]) if name.startswith("@") else pwd.getpwnam(name)
            except KeyError:
                kind = "group" if name.startswith("@") else "user"
                raise ValueError(f"there is no {kind} {name.removeprefix('@')} on this machine") from None
        return names

    def role_of(self, uid: int, gid: int, *, owner: int) -> Role:
        """Of a process with these credentials, at a daemon of this owner."""
        if not (self.admin or self.operator):
            return Role.ADMIN if uid in (0, owner) else Role.OBSERVER
        for role, names in ((Role.ADMIN, self.admin), (Role.OPERATOR, self.operator)):
            if _is_one_of(uid, gid, names):
                return role
        return Role.OBSERVER


def _is_one_of(uid: int, gid: int, names: Sequence[str]) -> bool:
    users = {pwd.getpwnam(name).pw_uid for name in names if not name.startswith("@")}
    groups = {grp.getgrnam(name[1:]).gr_gid for name in names if name.startswith("@")}
    return uid in users or bool(groups & {gid, *_groups(uid, gid)})


def _groups(uid: int, gid: int) -> list[int]:
    try:
        return os.getgrouplist(pwd.getpwuid(uid).pw_name, gid)
    except KeyError:  # a user without a name belongs to no group but that of its process
        return []


class TlsOptions(Data):
    """PEM files."""

    certificate: Annotated[str, Field(min_length=1, max_length=4096)]
    key: Annotated[str, Field(min_length=1, max_length=4096)]


class TcpOptions(Data):
    """The door on a network. Off unless the config has it."""

    host: Annotated[str, Field(min_length=1, max_length=255)] = "127.0.0.1"
    """An address of this machine."""
    port: Annotated[int, Field(ge=0, le=65535)]
    """0: any free one, told in the log."""
    token_file: Annotated[str, Field(min_length=1, max_length=4096)]
    """Holds the token that a client says first: at least 32 characters, readable for the owner alone (0600)."""
    role: Annotated[str, Field(pattern="^(observer|operator|admin)$")] = "operator"
    """What the token makes of its bearer."""
    tls: TlsOptions | None = None
    """Needed for every address but this machine's own."""

    @property
    def loopback(self) -> bool:
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @model_validator(mode="after")
    def _safe(self) -> Self:
        if self.tls is None and not self.loopback:
            raise ValueError(f"host {self.host} can be reached from outside: give tls, or keep to 127.0.0.1")
        return self


class DoorOptions(Data):
    """How much the daemon lets in. The defaults carry a robot and its tools."""

    tcp: TcpOptions | None = None
    clients: Annotated[int, Field(ge=1, le=100_000)] = 1000
    """Connections at once."""
    clients_per_user: Annotated[int, Field(ge=1, le=100_000)] = 64
    """Of one user, or through TCP of one address."""
    rate: Annotated[float, Field(gt=0, le=1e6)] | None = 1000.0
    """Requests/s of one client, over which it is read more slowly; null: no limit."""
    lease_ms: Annotated[int, Field(ge=100, le=60_000)] = 500
    """How long a client that moves servos may be silent before they do their `on_lost_client`."""
