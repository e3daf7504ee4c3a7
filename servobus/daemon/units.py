"""The files that make servobus a service of the system: a systemd unit, udev rules, and the user it runs as.

The unit takes everything away that a daemon on serial lines does not need. It cannot have PrivateDevices, which would hide the
ports.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

USER = "servobus"
CONFIG = "/etc/servobus/servobus.yaml"

UNIT = """\
[Unit]
Description=servobus, the owner of this robot's serial lines
# A config that is wrong stays wrong: give up after a few starts and say so.
StartLimitIntervalSec=30
StartLimitBurst=10

[Service]
Type=notify
ExecStart={command} run {config}
ExecReload=kill -HUP $MAINPID
Restart=on-failure
RestartSec=200ms
# A usage or config error is not healed by another start.
RestartPreventExitStatus=2
# Fed while the buses go on, see servobus.daemon.watchdog.
WatchdogSec=5
# SIGTERM applies each servo's on_exit; parking takes up to its park_timeout.
TimeoutStopSec=15

User={user}
Group={user}
SupplementaryGroups=dialout
RuntimeDirectory=servobus
RuntimeDirectoryMode=0750
UMask=0117

NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
DevicePolicy=closed
DeviceAllow=char-ttyUSB rw
DeviceAllow=char-ttyACM rw
DeviceAllow=char-ttyAMA rw
DeviceAllow=char-ttyS rw
ProtectSystem=strict
ProtectHome=yes
ProtectProc=invisible
ProcSubset=pid
PrivateTmp=yes
PrivateUsers=no
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictAddressFamilies={families}
{private_network}RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
RemoveIPC=yes
KeyringMode=private
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
LimitNOFILE=8192
MemoryMax=512M
TasksMax=64

[Install]
WantedBy=multi-user.target
"""

UDEV = """\
# Stable names for USB serial adapters: /dev/servobus/SERIAL, and -IFNN for adapters with several ports.
ACTION!="remove", SUBSYSTEM=="tty", SUBSYSTEMS=="usb", ENV{ID_SERIAL}=="?*", ENV{ID_USB_INTERFACE_NUM}=="?*", \\
    SYMLINK+="servobus/$env{ID_SERIAL}-if$env{ID_USB_INTERFACE_NUM}"
# FTDI adapters collect what they hear for 16 ms unless they are told not to.
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
"""

SYSUSERS = """\
# The daemon's user; whoever may talk to it belongs to its group.
u {user} - "servobus daemon" -
"""

AFTER = (
    "systemd-sysusers",
    "udevadm control --reload && udevadm trigger",
    "systemctl daemon-reload",
    "systemctl enable --now servobus",
)
"""What makes the files take effect."""


def files(command: str, config: str = CONFIG, *, network: bool = False) -> dict[PurePosixPath, str]:
    """Path on the system -> text. `command` is how servobus is started; `network`: the config has a TCP door, or lines that are
    reached through TCP."""
    families = "AF_UNIX AF_INET AF_INET6" if network else "AF_UNIX"
    unit = UNIT.format(
        command=_quoted(command),
        config=_quoted(config),
        user=USER,
        families=families,
        private_network="" if network else "PrivateNetwork=yes\nIPAddressDeny=any\n",
    )
    return {
        PurePosixPath("/etc/systemd/system/servobus.service"): unit,
        PurePosixPath("/etc/udev/rules.d/60-servobus.rules"): UDEV,
        PurePosixPath("/etc/sysusers.d/servobus.conf"): SYSUSERS.format(user=USER),
    }


def _quoted(text: str) -> str:
    """As one word of a unit file."""
    text = text.replace("%", "%%").replace("$", "$$")
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"' if set(text) & set(" \t\"'\\") else text


def write(texts: dict[PurePosixPath, str], root: Path, *, force: bool = False) -> list[Path]:
    """Put them under `root`. Files of other content are kept unless `force`: FileExistsError, and nothing is written."""
    places = {root / path.relative_to("/"): text for path, text in texts.items()}
    others = [place for place, text in places.items() if place.exists() and place.read_text() != text]
    if others and not force:
        raise FileExistsError(f"{_listing(others)} holds something else: look at it, then give --force")
    for place, text in places.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
        place.chmod(0o644)
    return list(places)


def _listing(places: Sequence[Path]) -> str:
    return ", ".join(map(str, places))
