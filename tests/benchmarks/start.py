"""How long servobus takes to start: `import servobus`, `servobus --help` and the `--help` of each command, as wall time."""

from __future__ import annotations

import statistics
import subprocess
import sys
from pathlib import Path
from time import perf_counter

from servobus.cli import COMMANDS
from tests.benchmarks.regime import one_busy_core
from tests.benchmarks.report import Report, Target

PYTHON = [sys.executable, "-c"]
SERVOBUS = [str(Path(sys.executable).parent / "servobus")]
HELP, SLOWEST = "servobus --help", "a command's --help, the slowest"


def wall_ms(command: list[str]) -> float:
    began = perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
    return 1000 * (perf_counter() - began)


def main(_: float, rounds: int) -> Report:
    helps = {f"servobus {name} --help": [*SERVOBUS, name, "--help"] for name in COMMANDS}
    commands = {
        "python -c pass": [*PYTHON, "pass"],
        "import servobus": [*PYTHON, "import servobus"],
        "servobus.open": [*PYTHON, "import servobus; servobus.open"],
        HELP: [*SERVOBUS, "--help"],
        **helps,
    }
    times: dict[str, list[float]] = {name: [] for name in commands}
    with one_busy_core():
        for command in commands.values():
            wall_ms(command)  # compiles what was not compiled yet
        for _ in range(rounds):
            for name, command in commands.items():
                times[name].append(wall_ms(command))
    medians = {name: statistics.median(each) for name, each in times.items()}
    slowest = max(helps, key=medians.__getitem__)
    rows = {name: {"wall ms": median} for name, median in medians.items() if name not in helps or name == slowest}
    rows[SLOWEST] = {"wall ms": medians[slowest]}
    return Report("start", rows, [Target(HELP, "wall ms", maximum=250), Target(SLOWEST, "wall ms", maximum=350)])
