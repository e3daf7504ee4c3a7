"""Each row of `scripts/soak safety` once: a rule about joints, with each protocol, model and mode that it applies to."""

from __future__ import annotations

import pytest

from tests.campaigns import safety
from tests.campaigns.bench import Case
from tests.campaigns.safety import RULES, Rule

ROWS = [pytest.param(rule, case, id=f"{rule.name}: {case}") for rule in RULES for case in rule.cases]


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "case"), ROWS)
def test_nothing_moves_by_surprise(rule: Rule, case: Case) -> None:
    figures = safety.run(rule, case, 1)
    assert figures.kept(), figures


COMMANDS = [pytest.param(rule, case, id=f"{rule.name}: {case}") for rule in safety.COMMANDS for case in rule.cases]


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "case"), COMMANDS)
def test_no_command_moves_by_surprise(rule: Rule, case: Case) -> None:
    figures = safety.run(rule, case, 1)
    assert figures.kept(), figures
