"""What README and the pages under docs/ show is true: links lead somewhere, commands exist, configs load, programs run."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

import click
import pytest

from servobus.cli import cli
from servobus.config.loader import parse_config
from tests.cli.processes import servobus, until
from tests.docs.blocks import PAGES, ROOT, blocks

LINK = re.compile(r"\]\(([^)#\s]+)(#[^)]*)?\)")
COMMANDS = [
    (page, line)
    for page in PAGES
    for block in blocks(page, "sh")
    for line in block.splitlines()
    if line.startswith("servobus ") and not line.startswith("servobus --")
]
OWN_PORTS = [(page, text) for page in PAGES for text in blocks(page, "python") if "servobus.open(" in text]
CONNECTING = [
    (page, text) for page in PAGES for text in blocks(page, "python") if ".connect(" in text and "servobus.open(" not in text
]
"""Programs of the pages: with ports of their own, and for a running daemon."""
SESSIONS = [(page, text) for page in PAGES for text in blocks(page, "sh") if text.startswith("servobus run")]


def test_the_readme_is_short() -> None:
    assert len(PAGES["README.md"].splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page: str) -> None:
    targets = [target for target, _ in LINK.findall(PAGES[page]) if "://" not in target]
    assert [target for target in targets if not (ROOT / page).parent.joinpath(target).exists()] == []


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_commands_and_their_options_exist(page: str, line: str) -> None:
    _, name, *arguments = [word for word in shlex.split(line, comments=True) if word != "&"]
    arguments = arguments[: arguments.index(">")] if ">" in arguments else arguments
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    command.make_context(name, arguments)


@pytest.mark.parametrize("text", blocks("README.md", "yaml"))
def test_the_config_of_the_readme_is_valid(text: str) -> None:
    assert set(parse_config(text, "README.md").names) == {"arm/shoulder", "arm/elbow"}


@pytest.fixture(autouse=True)
def _from_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pages name files as seen from there."""
    monkeypatch.chdir(ROOT)


def run(program: str) -> None:
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True, timeout=60)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "text"), OWN_PORTS)
def test_programs_with_ports_of_their_own(page: str, text: str) -> None:
    run(text)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "text"), CONNECTING)
def test_programs_for_a_daemon(page: str, text: str) -> None:
    with servobus("run", "config/sim.yaml") as process:
        until(process, "running")
        run(text)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "text"), SESSIONS)
def test_sessions_with_a_daemon(page: str, text: str) -> None:
    """The lines of the page one after another, once the daemon of its first line is ready."""
    first, *rest = text.splitlines()
    command = [sys.executable, "-m", "servobus"]
    _, *arguments = shlex.split(first.partition("&")[0])
    with servobus(*arguments) as process:
        until(process, "running")
        for line in rest:
            subprocess.run([*command, *shlex.split(line, comments=True)[1:]], check=True, stdout=subprocess.DEVNULL, timeout=60)
