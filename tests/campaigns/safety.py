"""Every rule about joints, against the witnesses: what moved that nobody asked for, and what was told that was not so.

A row is a rule with a case: protocol, model, mode, polls. Its scenario runs often, each time in a new virtual loop with a new
seed.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from servobus.errors import ServobusError
from tests.campaigns import commands, daemons, scenarios_goals, scenarios_mixed, scenarios_stops, scenarios_troubles
from tests.campaigns.bench import Case, Figures
from tests.virtual_time import VirtualLoop

Scenario = Callable[[Case, random.Random, Figures], Awaitable[None]]


@dataclass(frozen=True, slots=True)
class Rule:
    """A promise, the scenario that tries it, and the cases it applies to."""

    name: str
    scenario: Scenario
    cases: Sequence[Case]
    runs: int
    """Over all cases, where the whole campaign is run."""
    real: bool = False
    """In real time, with processes."""


ROWS = (*scenarios_goals.RULES, *scenarios_stops.RULES, *scenarios_troubles.RULES, *scenarios_mixed.RULES)
RULES = [Rule(name, scenario, cases, runs) for name, scenario, cases, runs in ROWS]
COMMANDS = [Rule(name, scenario, cases, runs, real=True) for name, scenario, cases, runs in (*commands.RULES, *daemons.RULES)]


def run(rule: Rule, case: Case, runs: int, seed: int = 1) -> Figures:
    """Run one row."""
    figures = Figures()
    for number in range(runs):
        rng = random.Random(f"{rule.name}/{case}/{seed}/{number}")
        with asyncio.Runner(loop_factory=None if rule.real else VirtualLoop) as runner:
            runner.run(_once(rule.scenario, case, rng, figures))
        figures.runs += 1
    return figures


async def _once(scenario: Scenario, case: Case, rng: random.Random, figures: Figures) -> None:
    try:
        await scenario(case, rng, figures)
    except ServobusError as error:  # of a verb that had to succeed
        figures.broken.append(f"{type(error).__name__}: {error.message}")


def safety(share: float, rules: Sequence[Rule] = (*RULES, *COMMANDS)) -> bool:
    """Run every row and print the table. `share`: of the runs of the whole campaign."""
    kept = True
    head = ("travel", "false stops", "owed", "fired", "energised")
    print(f"{'rule':44} {'case':52} {'runs':>5} " + " ".join(f"{name:>11}" for name in head))
    for rule in rules:
        for case in rule.cases:
            figures = run(rule, case, max(1, round(share * rule.runs / len(rule.cases))))
            kept &= figures.kept()
            print(line(rule, case, figures), flush=True)
            for text in sorted(set(figures.broken)):
                print(f"      BROKEN {figures.broken.count(text)} times: {text}")
    return kept


def line(rule: Rule, case: Case, figures: Figures) -> str:
    numbers = (figures.false_stops, figures.owed, figures.fired, figures.energised)
    cells = " ".join(f"{number:>11}" for number in (f"{figures.travel:.0f}", *numbers))
    return f"{rule.name:44} {case!s:52} {figures.runs:>5} {cells}"
