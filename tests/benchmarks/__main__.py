"""What `scripts/bench` runs: speed beside other clients, in one regime, as medians of interleaved rounds."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable

from tests.benchmarks import door, goals, kst, start, turns
from tests.benchmarks.report import Report

BENCHMARKS: dict[str, Callable[[float, int], Report]] = {
    "turns": turns.main,
    "goals": goals.main,
    "start": start.main,
    "kst": kst.main,
    "door": door.main,
}
"""Each takes the seconds of a round and the number of rounds."""


def main() -> int:
    """Status 1 when a figure misses its target."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="BENCHMARK", help=f"{', '.join(BENCHMARKS)}; all if none is named")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--seconds", type=float, default=1.0, help="of one client in one round (1)")
    parser.add_argument("--rounds", type=int, default=5, help="interleaved rounds, of which the median counts (5)")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(BENCHMARKS):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}: there are {', '.join(BENCHMARKS)}")
    logging.getLogger("servobus").setLevel(logging.ERROR)
    reports = {}
    for name in arguments.names or BENCHMARKS:
        reports[name] = BENCHMARKS[name](arguments.seconds, arguments.rounds)
        if not arguments.json:
            reports[name].print()
    if arguments.json:
        print(json.dumps({name: report.as_json() for name, report in reports.items()}, indent=2))
    return 1 if any(report.missed() for report in reports.values()) else 0


sys.exit(main())
