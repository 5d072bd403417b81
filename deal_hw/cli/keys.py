"""``deal-hw keys``: certificates for the Go2's bridge and its clients."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deal_hw.drivers.transports.certificates import (
    AUTHORITY,
    Certificate,
    make_authority,
    read_certificate,
    sign,
)
from deal_hw.errors import ConfigurationError
from deal_hw.ranges import Checked, Range
from deal_hw.workflows.kinds import InputKind, sub_verbs

Days = Annotated[float, Range(1, 36500, "days")]
WARN_DAYS = 30
"""`show` warns of a certificate that expires within this time."""


@dataclass(frozen=True, kw_only=True)
class Make(Checked):
    """Make an authority, and certificates for the robot, a controller and an observer."""

    out: Path
    """Folder for the files; made if missing. No file in it is overwritten."""

    robot: tuple[str, ...]
    """Addresses or host names under which clients reach the bridge, such as 192.168.1.20."""

    controllers: tuple[str, ...] = ("controller",)
    """Names of the clients that may command the robot; one certificate each."""

    observers: tuple[str, ...] = ("observer",)
    """Names of the clients that may only read."""

    days: Days = 825
    """How long the certificates are valid [days]."""

    authority_days: Days = 3650
    """How long the authority is valid [days]."""


@dataclass(frozen=True, kw_only=True)
class Add(Checked):
    """Make one more certificate with an existing authority."""

    folder: tyro.conf.Positional[Path]
    """Folder with ca.pem and ca.key."""

    name: tyro.conf.Positional[str]
    """Name in the certificate; the bridge's options --controllers and --observers give it its rights."""

    addresses: tuple[str, ...] = ()
    """For a robot: addresses or host names under which clients reach it."""

    days: Days = 825
    """How long the certificate is valid [days]."""


@dataclass(frozen=True, kw_only=True)
class Show(Checked):
    """Show the role of each certificate in a folder, and how long it is still valid."""

    folder: tyro.conf.Positional[Path]
    """The folder."""


KINDS = sub_verbs(
    make=InputKind(Make, example="make --out keys --robot 192.168.1.20"),
    add=InputKind(Add, example="add keys observer2"),
    show=InputKind(Show, example="show keys"),
)


def keys(config: Make | Add | Show) -> int:
    """Make or show certificates; return the exit status, 1 if a shown certificate has expired.

    Raises:
        ConfigurationError: A name or address is invalid, or a file exists already.
        MissingExtraError: cryptography is not installed.
    """
    now = datetime.datetime.now(datetime.timezone.utc)
    if isinstance(config, Show):
        return _show(config.folder, now)
    if isinstance(config, Add):
        path = sign(config.folder, config.name, addresses=config.addresses, days=config.days, now=now)
        print(_line(read_certificate(path), now))
        return 0
    make(config, now)
    _show(config.out, now)
    host, client = config.robot[0], config.controllers[0]
    print(
        f"\nTo the robot's computer: {AUTHORITY}.pem, robot.pem, robot.key. To each client: {AUTHORITY}.pem "
        f"and its own two files.\n{AUTHORITY}.key signs new certificates: keep it on this machine, or "
        "offline. Keys have no password: guard the files.\n"
        f"  robot   deal-hw bridge go2 --port eth0 --listen tls/{host}:7447 {_files('robot')}\n"
        f"  client  deal-hw doctor go2 --transport zenoh --port tls/{host}:7447 {_files(client)}"
    )
    return 0


def make(config: Make, now: datetime.datetime) -> None:
    """Make the files of ``keys make``.

    Args:
        config: Settings.
        now: The time, UTC.

    Raises:
        ConfigurationError: As :func:`keys`.
    """
    names = ("robot", *config.controllers, *config.observers)
    if len(set(names)) < len(names):
        raise ConfigurationError(f"names {', '.join(names)}: each certificate needs a name of its own")
    if not config.robot or not config.controllers:
        raise ConfigurationError("name at least one address of the robot and one controller")
    make_authority(config.out, config.authority_days, now)
    for name in names:
        addresses = config.robot if name == "robot" else ()
        sign(config.out, name, addresses=addresses, days=config.days, now=now)


def _files(name: str) -> str:
    return f"--ca {AUTHORITY}.pem --certificate {name}.pem --key {name}.key"


def _show(folder: Path, now: datetime.datetime) -> int:
    found = [read_certificate(path) for path in sorted(folder.glob("*.pem"))]
    if not found:
        raise ConfigurationError(f"{folder} holds no certificates (*.pem); `deal-hw keys make` makes some")
    for certificate in found:
        print(_line(certificate, now))
    return int(any(certificate.days_left(now) < 0 for certificate in found))


def _line(certificate: Certificate, now: datetime.datetime) -> str:
    left = certificate.days_left(now)
    until = f"{certificate.expires:%Y-%m-%d %H:%M} UTC"
    if left < 0:
        life = f"EXPIRED on {until}: make a new one (`deal-hw keys add`)"
    elif certificate.begins > now:
        life = f"NOT VALID before {certificate.begins:%Y-%m-%d %H:%M} UTC: is this clock right?"
    else:
        life = f"{left:.0f} days left (until {until})" + ("; renew it soon" if left < WARN_DAYS else "")
    role = "authority" if certificate.authority else f"for {', '.join(certificate.addresses) or 'nothing'}"
    key = "no key here"
    if certificate.key is not None:
        key = f"key {certificate.key.name}, mode {certificate.key_mode:04o}"
        if certificate.key_mode & 0o077:
            key += f": others can read it, chmod 600 {certificate.key}"
    return f"{certificate.path.name:<20} {certificate.name:<20} {role}; {life}; {key}"
