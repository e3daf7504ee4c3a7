"""The files that make servobus a service of the system: a systemd unit, udev rules, and the user it runs as.

The unit removes all rights that a daemon on serial lines does not need, but not PrivateDevices: that would hide the ports.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

USER = "servobus"
CONFIG = "/etc/servobus/servobus.yaml"

UNIT = """\
[Unit]
Description=servobus, the owner of this robot's serial lines
# A wrong config stays wrong: give up after a few starts.
StartLimitIntervalSec=30
StartLimitBurst=10

[Service]
Type=notify
ExecStart={command} run {config}
ExecReload=kill -HUP $MAINPID
Restart=on-failure
RestartSec=200ms
# Another start does not help against a usage or config error.
RestartPreventExitStatus=2
# Fed while every bus makes progress, see servobus.daemon.watchdog.
WatchdogSec=5
# SIGTERM applies each servo's on_exit; parking takes up to its park_timeout.
TimeoutStopSec=15

User={user}
Group={user}
SupplementaryGroups=dialout
RuntimeDirectory=servobus
RuntimeDirectoryMode=0750
RuntimeDirectoryPreserve=yes
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
# FTDI adapters collect received bytes for 16 ms unless this is set.
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
"""

SYSUSERS = """\
# The daemon's user; users who may connect belong to its group.
u {user} - "servobus daemon" -
"""

AFTER = (
    "systemd-sysusers",
    "udevadm control --reload && udevadm trigger",
    "systemctl daemon-reload",
    "systemctl enable --now servobus",
)
"""Commands that make the files take effect."""


def files(command: str, config: str = CONFIG, *, network: bool = False) -> dict[PurePosixPath, str]:
    """The files: path on the system -> text.

    Args:
        command: The command that starts servobus.
        config: Path of the config.
        network: The config has a TCP door, or lines that are reached by TCP.
    """
    families = "AF_UNIX AF_INET AF_INET6" if network else "AF_UNIX"
    private = "" if network else "PrivateNetwork=yes\nIPAddressDeny=any\n"
    names = {"command": _quoted(command), "config": _quoted(config), "user": USER}
    unit = UNIT.format(**names, families=families, private_network=private)
    return {
        PurePosixPath("/etc/systemd/system/servobus.service"): unit,
        PurePosixPath("/etc/udev/rules.d/60-servobus.rules"): UDEV,
        PurePosixPath("/etc/sysusers.d/servobus.conf"): SYSUSERS.format(user=USER),
    }


def _quoted(text: str) -> str:
    """Text as one word of a unit file."""
    text = text.replace("%", "%%").replace("$", "$$")
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"' if set(text) & set(" \t\"'\\") else text


def write(texts: dict[PurePosixPath, str], root: Path, *, force: bool = False) -> list[Path]:
    """Write the files under `root`. Raises FileExistsError where one has other content, unless `force`."""
    targets = {root / path.relative_to("/"): text for path, text in texts.items()}
    others = [path for path, text in targets.items() if path.exists() and path.read_text() != text]
    if others and not force:
        raise FileExistsError(f"{', '.join(map(str, others))} has other content: look at it, then give --force")
    for path, text in targets.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o644)
    return list(targets)
