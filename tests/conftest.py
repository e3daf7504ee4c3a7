"""Fixtures of several folders: no test meets a daemon of this machine, and a certificate for this machine's own address."""

from __future__ import annotations

import gc
import shutil
import subprocess
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

FOREIGN = (
    "COLUMNS",
    "FORCE_COLOR",
    "NOTIFY_SOCKET",
    "NO_COLOR",
    "RUNTIME_DIRECTORY",
    "SERVOBUS_CA_FILE",
    "SERVOBUS_CONFIG",
    "SERVOBUS_SOCKET",
    "SERVOBUS_TOKEN_FILE",
    "WATCHDOG_PID",
    "WATCHDOG_USEC",
)
"""Variables of the caller that would change what a command does."""

SYSTEM_SOCKET = Path("/run/servobus/servobus.sock")
NUMBERS = count()
"""One folder a test, with a short name: the path of a Unix socket has at most 107 bytes."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-skips", action="store_true", help="a skipped test fails the run")


def pytest_sessionstart() -> None:
    """The system's daemon cannot be hidden from commands that look for one, and tests would move its servos."""
    if SYSTEM_SOCKET.exists():
        pytest.exit(f"a servobus daemon of this machine has {SYSTEM_SOCKET}: stop it before the tests", returncode=2)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect no garbage meanwhile: see `tests/__main__.py`."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """On CI everything that a test needs is installed, so that a skip is a mistake of the setup."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.getoption("--no-skips") and reporter and reporter.stats.get("skipped") and exitstatus == 0:
        reporter.write_line("tests were skipped, which --no-skips forbids", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def isolate(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Sockets of this process, and of those it starts, are in the folder; nothing is taken from the caller's settings."""
    folder.mkdir(parents=True, mode=0o700)
    for name in FOREIGN:
        patch.delenv(name, raising=False)
    patch.setenv("XDG_RUNTIME_DIR", str(folder))


@pytest.fixture(scope="session", autouse=True)
def _isolated_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """For fixtures that start a process for a whole file."""
    with pytest.MonkeyPatch.context() as patch:
        isolate(patch, tmp_path_factory.getbasetemp() / "run" / "session")
        yield


@pytest.fixture(autouse=True)
def _isolated(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A daemon that runs on this machine, or that another test left, is out of sight."""
    isolate(monkeypatch, tmp_path_factory.getbasetemp() / "run" / str(next(NUMBERS)))


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The certificate and its key."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("no openssl here to make a certificate with")
    folder = tmp_path_factory.mktemp("tls")
    key, made = folder / "key.pem", folder / "certificate.pem"
    arguments = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    where = ["-subj", "/CN=test", "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(made)]
    subprocess.run([openssl, *arguments, *where], check=True, capture_output=True, timeout=30)
    return made, key
