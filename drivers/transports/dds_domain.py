"""DDS domains of this process: configured by us, shared by its transports, closed with the last of them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from deal_hw.drivers.transports.interfaces import Interface
from deal_hw.errors import ConfigurationError, MissingExtraError, TransportError

_LINGER: Final = "100 ms"
"""Longest wait of closing for peers that have not confirmed the last message; Cyclone's default is 1 s."""

_SEEK: Final = "1 s"
"""Time between two announcements of our participant.

With Cyclone's longer default, the connection takes longer to come back after a cable was out.
"""
_LOG_FATAL, _LOG_ERROR, _LOG_WARNING = 1, 2, 4


@dataclass(slots=True)
class _Opened:
    interface: str
    domain: Any
    users: int
    pid: int


_OPENED: Final[dict[int, _Opened]] = {}


def domain_xml(number: int, interface: Interface) -> str:
    """Return Cyclone's configuration of a domain on one interface.

    On loopback the interface is given by address and multicast is forced: ``lo`` lacks the flag, yet carries
    multicast, and this is the one form in which Cyclone DDS 0.10.2 and 11 find each other there.
    """
    if interface.loopback:
        where = f"address={quoteattr(interface.addresses[0])} multicast={quoteattr('true')}"
    else:
        where = f"name={quoteattr(interface.name)} multicast={quoteattr('default')}"
    return (
        f'<CycloneDDS><Domain Id="{number}"><General><Interfaces><NetworkInterface {where}/></Interfaces>'
        f"</General><Discovery><SPDPInterval>{_SEEK}</SPDPInterval></Discovery>"
        f"<Internal><WriterLingerDuration>{_LINGER}</WriterLingerDuration></Internal>"
        "</Domain></CycloneDDS>"
    )


def acquire_domain(number: int, interface: Interface) -> None:
    """Open a domain, or join the one that this process has open; each call needs a release.

    Environment variables are ignored: scripts of ROS set ``CYCLONEDDS_URI``, which often names another
    interface.

    Raises:
        MissingExtraError: cyclonedds is not installed.
        ConfigurationError: The process has this domain open on another interface.
        TransportError: Cyclone cannot open it.
    """
    opened = _OPENED.get(number)
    if opened is None:
        domain = _create(number, interface)
        opened = _OPENED[number] = _Opened(interface.name, domain, 0, os.getpid())
    if opened.pid != os.getpid():
        raise TransportError(
            f"DDS domain {number} was open when this process was forked, and DDS does not survive a fork: "
            "start the process anew (multiprocessing's `spawn`)"
        )
    if opened.interface != interface.name:
        raise ConfigurationError(
            f"DDS domain {number} is open in this process on {opened.interface!r}, so not on "
            f"{interface.name!r} too; close that transport first or take another domain"
        )
    opened.users += 1


def release_domain(number: int) -> None:
    """Give a domain back; the last user closes it."""
    opened = _OPENED[number]
    opened.users -= 1
    if opened.users == 0:
        del _OPENED[number]
        delete_entities([opened.domain])


def delete_entities(entities: Sequence[Any]) -> None:
    """Delete DDS entities now, the youngest first.

    cyclonedds deletes an entity with its Python object, whenever that is: a traceback that still holds the
    transport would keep the participant on the wire.
    """
    for entity in reversed(entities):
        entity.__del__()


@contextmanager
def dds_errors(what: str) -> Iterator[None]:
    """Convert Cyclone's errors to ours."""
    from cyclonedds.core import DDSException

    try:
        yield
    except DDSException as error:
        raise TransportError(f"{what}: {error}") from error


def _create(number: int, interface: Interface) -> Any:
    try:
        from cyclonedds.domain import Domain
        from cyclonedds.internal import DDS
    except ImportError as error:
        raise MissingExtraError("cyclonedds", "dds") from error
    set_log_mask = DDS._dll_handle.dds_set_log_mask
    set_log_mask(_LOG_FATAL | _LOG_ERROR | _LOG_WARNING)
    with dds_errors(f"DDS domain {number} cannot be opened on {interface}"):
        domain = Domain(number, domain_xml(number, interface))
    # From now on Cyclone prints nothing. With the interface down it would write a line for each send, and a
    # slow terminal would block the control loop. Missing states of the robot show the fault instead.
    set_log_mask(_LOG_FATAL)
    return domain
