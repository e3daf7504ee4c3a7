"""The list of ports: the names of each, and the process that has it open."""

from __future__ import annotations

import os
from pathlib import Path

from serial.tools.list_ports_common import ListPortInfo

from servobus.links.ports import PortInfo, describe, links_in, list_ports
from tests.links.bare_pty import plugged


def test_links_that_lead_to_a_port(tmp_path: Path) -> None:
    folder = tmp_path / "by-id"
    folder.mkdir()
    for name in ("ttyUSB0", "ttyUSB1"):
        (tmp_path / name).touch()
    (folder / "usb-1a86_USB_Serial-if00-port0").symlink_to("../ttyUSB0")
    (folder / "usb-FTDI_FT232R-if00-port0").symlink_to("../ttyUSB1")
    assert links_in(folder) == {
        str(tmp_path / "ttyUSB0"): str(folder / "usb-1a86_USB_Serial-if00-port0"),
        str(tmp_path / "ttyUSB1"): str(folder / "usb-FTDI_FT232R-if00-port0"),
    }


def test_without_udev_there_are_no_links(tmp_path: Path) -> None:
    assert links_in(tmp_path / "by-id") == {}


def test_a_port_is_described() -> None:
    with plugged() as pty:
        port = ListPortInfo(pty.path)
        port.description, port.manufacturer, port.serial_number = "USB Serial", "1a86", "A50285BI"
        port.vid, port.pid = 0x1A86, 0x7523
        info = describe(port, {pty.path: "/by-id/usb"}, {"/dev/other": "/by-path/other", pty.path: "/by-path/1.2"})
        name = Path("/proc/self/comm").read_text().strip()
        holder = (os.getpid(), name)
    assert info == PortInfo(pty.path, "/by-id/usb", "/by-path/1.2", "USB Serial", "1a86", "A50285BI", 0x1A86, 0x7523, holder)


def test_what_nobody_knows_is_none(tmp_path: Path) -> None:
    device = str(tmp_path / "ttyS0")
    assert describe(ListPortInfo(device), {}, {}) == PortInfo(device, None, None, None, None, None, None, None, None)


def test_the_ports_of_this_machine() -> None:
    """Whatever they are: each is there, and they are in order."""
    devices = [port.device for port in list_ports()]
    assert devices == sorted(devices)
    assert all(os.path.exists(device) for device in devices)
