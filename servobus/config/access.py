"""Who may use a daemon and in which role: the YAML keys `access` and `door`.

A role may do what the roles below it may do. On the Unix socket the role follows from the user and groups of the client's
process, as the kernel reports them; through TCP it follows from the token.
"""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from servobus.protocols.model import Data
from servobus.values import Role, is_loopback

__all__ = ["AccessOptions", "DoorOptions", "Role", "TcpOptions", "TlsOptions"]

UserOrGroup = Annotated[str, Field(pattern=r"^@?[A-Za-z_][A-Za-z0-9_.-]{0,31}\$?$")]
Users = Annotated[tuple[UserOrGroup, ...], Field(strict=False)]
"""A YAML list."""


class AccessOptions(Data):
    """Roles of users and of groups (`@name`). With neither key, the daemon's owner and root are admin and all others observer."""

    admin: Users = ()
    """Users and groups that may also change ids, baud rates, EEPROM registers and the config."""
    operator: Users = ()
    """Users and groups that may move servos. All others may read, and stop."""

    @field_validator("admin", "operator")
    @classmethod
    def _exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            try:
                grp.getgrnam(name[1:]) if name.startswith("@") else pwd.getpwnam(name)
            except KeyError:
                kind = "group" if name.startswith("@") else "user"
                raise ValueError(f"there is no {kind} {name.removeprefix('@')} on this machine") from None
        return names

    def role_of(self, uid: int, gid: int, *, owner: int) -> Role:
        """The role of a process with these ids, at a daemon whose owner has the user id `owner`."""
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
    except KeyError:  # a user without a name is in the group of its process alone
        return []


class TlsOptions(Data):
    """The certificate of a TCP door."""

    certificate: Annotated[str, Field(min_length=1, max_length=4096)]
    """Path of the certificate chain, a PEM file."""
    key: Annotated[str, Field(min_length=1, max_length=4096)]
    """Path of the private key, a PEM file."""


class TcpOptions(Data):
    """The daemon's TCP port. Without this section there is none."""

    host: Annotated[str, Field(min_length=1, max_length=255)] = "127.0.0.1"
    """Address of this machine to listen at. An address other than loopback needs `tls`."""
    port: Annotated[int, Field(ge=0, le=65535)]
    """TCP port; 0 takes a free one, which the log names."""
    token_file: Annotated[str, Field(min_length=1, max_length=4096)]
    """Path of the file with the token that a client sends first: at least 32 characters, mode 0600."""
    role: Annotated[str, Field(pattern="^(observer|operator|admin)$")] = "operator"
    """Role of the clients that send the token."""
    tls: TlsOptions | None = None
    """Certificate and key for connections from other machines."""

    @model_validator(mode="after")
    def _safe(self) -> Self:
        if self.tls is None and not is_loopback(self.host):
            raise ValueError(f"host {self.host} can be reached from other machines: give tls, or use 127.0.0.1")
        return self


class DoorOptions(Data):
    """Limits of the daemon's clients, and its TCP port. The defaults are enough for a robot and its tools."""

    tcp: TcpOptions | None = None
    """A TCP port beside the Unix socket."""
    clients: Annotated[int, Field(ge=1, le=100_000)] = 1000
    """Highest number of connections."""
    clients_per_user: Annotated[int, Field(ge=1, le=100_000)] = 64
    """Highest number of connections of one user, or of one address through TCP."""
    rate: Annotated[float, Field(gt=0, le=1e6)] | None = 1000.0
    """Requests/s of one client; a client that sends more is read more slowly. null: no limit."""
    lease_ms: Annotated[int, Field(ge=100, le=60_000)] = 500
    """Time in ms that a client with a motion lease may be silent; then its servos do their `on_lost_client`."""
