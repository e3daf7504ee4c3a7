"""What `scripts/soak` runs: long campaigns that print their figures."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable

from tests.campaigns import crowd, daemon, days, dead_servo, estop, faults, safety, slow_hand
from tests.campaigns.oracle import ORACLES

WHOLE = 1_000_000


def soak_faults(count: int) -> bool:
    kept = True
    for protocol in ORACLES:
        result = faults.faults(count, protocol=protocol)
        result.report(f"{protocol}: 1 % mixed faults, replies delivered whole")
        residual = faults.faults(count // 10, protocol=protocol, chop="bytes")
        residual.report(f"{protocol}: the same, delivered byte by byte (the residual of an 8-bit sum)")
        kept &= not (result.wrong or result.hung or result.leaked or result.waiting)
    return kept


def soak_cancel(count: int) -> bool:
    kept = True
    for protocol in ORACLES:
        result = faults.cancel(count // 10, protocol=protocol)
        result.report(f"{protocol}: cancelled callers")
        kept &= not (result.wrong or result.hung or result.leaked or result.waiting)
    return kept


def soak_hand(_: int) -> bool:
    result = slow_hand.slow_hand(10_000)
    result.report("roh: a hand slower than the deadline, 10 000 reads of changing registers")
    return not (result.wrong or result.hung or result.leaked or result.waiting)


def soak_line(_: int) -> bool:
    figures = dead_servo.main()
    return (
        figures.rate_with_dead >= 0.8 * figures.rate_before
        and figures.unplug < 0.05
        and figures.replug < 0.25
        and figures.cpu < 0.02
    )


def soak_kill(_: int) -> bool:
    result = daemon.kills(200)
    result.report()
    return not (result.late or result.writes)


def soak_daemon(_: int) -> bool:
    result = crowd.crowd()
    result.report()
    return result.kept()


def soak_safety(count: int) -> bool:
    return safety.safety(count / WHOLE)


def soak_estop(count: int) -> bool:
    kept = True
    for setting in estop.SETTINGS:
        for real in (True, False):
            latency = estop.estop(setting, max(1, 200 * count // WHOLE), real=real)
            latency.report()
            kept &= not latency.unconfirmed
    return kept


def soak_days(hours: float) -> bool:
    result = days.days(hours)
    result.report()
    return result.kept()


CAMPAIGNS: dict[str, Callable[[int], bool]] = {
    "faults": soak_faults,
    "cancel": soak_cancel,
    "hand": soak_hand,
    "line": soak_line,
    "kill": soak_kill,
    "daemon": soak_daemon,
    "safety": soak_safety,
    "estop": soak_estop,
}
NAMES = (*CAMPAIGNS, "days")


def main() -> int:
    """Status 1 when a figure misses what it has to reach."""
    parser = argparse.ArgumentParser(prog="scripts/soak", description=__doc__)
    parser.add_argument("campaigns", nargs="*", metavar="CAMPAIGN", help=f"{', '.join(NAMES)}; all if none is named")
    parser.add_argument("--count", type=int, default=WHOLE, help="reads of the faults campaign; the others scale with it")
    parser.add_argument("--hours", type=float, default=1.5, help="virtual hours of the days campaign")
    arguments = parser.parse_args()
    if unknown := set(arguments.campaigns) - set(NAMES):
        parser.error(f"no campaign {', '.join(sorted(unknown))}: there are {', '.join(NAMES)}")
    logging.getLogger("servobus").setLevel(logging.ERROR)
    campaigns = CAMPAIGNS | {"days": lambda _: soak_days(arguments.hours)}
    kept = [campaigns[name](arguments.count) for name in arguments.campaigns or campaigns]
    return 0 if all(kept) else 1


sys.exit(main())
