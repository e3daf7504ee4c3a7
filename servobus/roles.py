"""What somebody at a door may do. A role can do what the roles before it can; who has which stands in `access.py`."""

from __future__ import annotations

from enum import IntEnum


class Role(IntEnum):
    """In the order of what they may."""

    NOBODY = 0
    """Has not shown a token yet."""
    OBSERVER = 1
    """Reads, and stops: anyone may stop."""
    OPERATOR = 2
    """Moves."""
    ADMIN = 3
    """Changes what stays: ids, rates, EEPROM, the config."""

    def __str__(self) -> str:
        return self.name.lower()
