"""The page of the daemon's protocol: its examples, letter by letter, over a real socket."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.daemon.raw_client import dialled, served
from tests.simulated_rigs import config
from tests.virtual_time import virtual

PAGE = Path(__file__).parents[2] / "docs" / "native-door.md"
EXAMPLES = re.findall(r"^## (\w+).*?\n```\n(.*?)```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
RIG = "shoulder: {id: 1, model: sts, on_estop: hold}", "elbow: {id: 2, model: sts, on_estop: hold}"


def test_it_has_examples() -> None:
    assert [title for title, _ in EXAMPLES] == ["Reading", "Moving", "Stopping", "Errors", "Subscriptions"]


@pytest.mark.parametrize(("title", "text"), EXAMPLES)
@virtual
async def test_example(title: str, text: str, tmp_path: Path) -> None:
    async with served(tmp_path, config(*RIG)) as (_, _, path), dialled(path) as raw:
        for line in text.splitlines():
            if line.startswith("-> "):
                raw.say(line[3:].encode() + b"\n")
                continue
            reply = (await raw.reader.readline()).decode().rstrip()
            assert re.fullmatch(re.escape(line[3:]).replace(re.escape("..."), ".+?"), reply), f"{title}: {reply}"
