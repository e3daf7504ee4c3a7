"""The rows and tests that the safety page names exist, and it names every row."""

from __future__ import annotations

import re

import pytest

from tests.campaigns.safety import COMMANDS, RULES
from tests.docs.blocks import PAGES, ROOT
from tests.house.sources import parsed

PROOF = PAGES["docs/safety.md"].partition("## How it is proved")[2].partition("\n## ")[0]
TABLE = [line.strip("|").split("|") for line in PROOF.splitlines() if line.startswith("|")][2:]
QUOTED = re.compile(r"`([^`]+)`")


def test_it_names_every_row_of_the_campaign_and_no_other() -> None:
    named = {name for cells in TABLE for name in QUOTED.findall(cells[1])}
    assert named == {rule.name for rule in (*RULES, *COMMANDS)}


@pytest.mark.parametrize("name", sorted({name for cells in TABLE for name in QUOTED.findall(cells[2])}))
def test_it_names_tests_that_exist(name: str) -> None:
    path, _, test = name.partition("::")
    defined = {node.name for node in parsed(ROOT / path).body if hasattr(node, "name")}
    assert test in defined
