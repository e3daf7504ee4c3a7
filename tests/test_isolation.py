"""No test meets a daemon of this machine: a socket is looked for in a folder of the test's own, in this process and in others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from servobus.rpc.socket_path import find_socket, socket_path

SHOW = "from servobus.rpc.socket_path import find_socket, socket_path; print(find_socket(), socket_path())"


@pytest.fixture(scope="module")
def environment_of_the_file() -> dict[str, str]:
    return dict(os.environ)


def in_a_process(environment: dict[str, str]) -> tuple[str, Path]:
    shown = subprocess.run([sys.executable, "-c", SHOW], env=environment, check=True, capture_output=True, text=True, timeout=60)
    socket, path = shown.stdout.split()
    return socket, Path(path)


def test_sockets_are_in_a_folder_of_the_test(
    tmp_path_factory: pytest.TempPathFactory, environment_of_the_file: dict[str, str]
) -> None:
    own = tmp_path_factory.getbasetemp()
    assert find_socket() is None
    assert socket_path().is_relative_to(own)
    for environment in (dict(os.environ), environment_of_the_file):
        socket, path = in_a_process(environment)
        assert (socket, path.is_relative_to(own)) == ("None", True)
