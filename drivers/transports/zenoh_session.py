"""Settings of a Zenoh session: end points, access, no discovery, short queues."""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deal_hw.errors import ConfigurationError, PortNotFoundError, TransportTimeoutError
from deal_hw.transport import WireOptions

OPEN_TIMEOUT_S: Final = 3.0
"""Longest wait for a session with the end points [s]."""
PROBE_TIMEOUT_S: Final = 2.0
_PROTOCOLS: Final = ("tcp", "udp", "tls")
_FORM: Final = re.compile(r"(\w+)/(\[[0-9a-fA-F:.%\w]+\]|[^\s\[\]:/?#]+):(\d{1,5})")
_BUFFER_BYTES: Final = 16_384
_LEASE_MS: Final = 2000
_RETRY_MS: Final = (100, 1000)
_NOT_YET_VALID, _EXPIRED = 9, 10
"""Codes of OpenSSL (X509_V_ERR_...)."""
_FLIGHTS: Final = 4
"""Most messages in both directions of a handshake."""
_ALERTS: Final = {
    "CERTIFICATE_REQUIRED": "it requires a certificate of ours: give --certificate and --key",
    "CERTIFICATE_EXPIRED": (
        "it finds our certificate expired, or not valid yet: is the other computer's clock right? "
        "`deal-hw keys show DIR` shows how long ours is valid"
    ),
    "UNKNOWN_CA": (
        "it does not know the authority that signed our certificate: both sides need the same ca.pem"
    ),
}
"""Parts of OpenSSL's names for a peer's refusal of our certificate -> meaning."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An end point at which a session listens, or to which it connects.

    Attributes:
        protocol: "tcp", "udp" or "tls".
        host: Name or address, an IPv6 address without its brackets.
        port: Number of the port.
    """

    protocol: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}/{host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether it is on this machine; of names only "localhost" counts."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_endpoints(port: str) -> tuple[Endpoint, ...]:
    """Return the end points of a text such as ``"tls/192.168.123.18:7447,tcp/127.0.0.1:7447"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    return tuple(_parse(part.strip()) for part in port.split(","))


def _parse(text: str) -> Endpoint:
    match = _FORM.fullmatch(text)
    if match is None or not 0 < int(match[3]) < 65536:
        raise ConfigurationError(
            f"Zenoh end point {text!r}: write protocol/host:port, such as tcp/127.0.0.1:7447 or "
            "tls/192.168.123.18:7447; several are separated by commas"
        )
    if match[1] not in _PROTOCOLS:
        raise ConfigurationError(f"Zenoh end point {text!r}: the protocol is one of {', '.join(_PROTOCOLS)}")
    return Endpoint(match[1], match[2].strip("[]"), int(match[3]))


def check_security(endpoints: Sequence[Endpoint], options: WireOptions) -> None:
    """Refuse settings that would let strangers command the robot.

    Raises:
        ConfigurationError: Plain text would leave this machine, files for TLS are missing or unusable, or a
            client is set to listen.
    """
    if options.listen and options.session_mode == "client":
        raise ConfigurationError("a Zenoh client cannot listen: use mode peer, or do not listen")
    for endpoint in endpoints:
        if endpoint.protocol != "tls" and not endpoint.loopback and not options.insecure:
            raise ConfigurationError(
                f"{endpoint} is plain {endpoint.protocol.upper()} beyond this machine: everybody who "
                f"reaches the port can command the robot. Use tls/{endpoint.host}:{endpoint.port} with "
                "--ca, --certificate and --key, or allow it with --insecure on a network that you trust"
            )
    if any(endpoint.protocol == "tls" for endpoint in endpoints):
        _check_files(options)


def _check_files(options: WireOptions) -> None:
    if options.ca is None:
        raise ConfigurationError("a tls/ end point needs --ca: the authority that signed the peer (PEM)")
    if options.listen and options.certificate is None:
        raise ConfigurationError("listening on a tls/ end point needs --certificate and --key (PEM)")
    tls_context(options)
    code, text = own_certificate_trouble(options)
    if code in (_NOT_YET_VALID, _EXPIRED):
        raise ConfigurationError(
            f"{options.certificate}, or its authority {options.ca}: {text}. Check this computer's clock, "
            "or make a new one (`deal-hw keys add`); `deal-hw keys show DIR` shows how long each is valid"
        )


def own_certificate_trouble(options: WireOptions) -> tuple[int, str]:
    """Return OpenSSL's code and text for a fault of our certificate; 0 and "" for none.

    The check is a handshake with ourselves, in memory, because a peer's refusal would only close the
    connection.
    """
    if options.certificate is None or options.ca is None:
        return 0, ""
    judge, bearer = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    for context in (judge, bearer):
        context.load_cert_chain(options.certificate, options.key, password=lambda: "")
    judge.verify_mode = ssl.CERT_REQUIRED
    judge.load_verify_locations(options.ca)
    bearer.check_hostname, bearer.verify_mode = False, ssl.CERT_NONE
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = bearer.wrap_bio(back, there), judge.wrap_bio(there, back, server_side=True)
    try:
        for _ in range(_FLIGHTS):
            for side in sides:
                with contextlib.suppress(ssl.SSLWantReadError):
                    side.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return error.verify_code, error.verify_message
    return 0, ""


def tls_context(options: WireOptions) -> ssl.SSLContext:
    """Return a TLS context from the files, after a check that they can be read and match.

    Raises:
        ConfigurationError: They cannot be read, or do not match.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    for path in (options.ca, options.certificate, options.key):
        if path is not None:
            _check_readable(path)
    try:
        context.load_verify_locations(cafile=options.ca)
    except (ssl.SSLError, OSError) as error:
        raise ConfigurationError(f"{options.ca} holds no certificate in PEM form ({error})") from error
    if options.certificate is not None and options.key is not None:
        try:
            # Without a password function OpenSSL would prompt at the terminal.
            context.load_cert_chain(options.certificate, options.key, password=lambda: "")
        except (ssl.SSLError, OSError) as error:
            raise ConfigurationError(
                f"{options.certificate} and {options.key} are no certificate with its unencrypted private "
                f"key in PEM form ({error})"
            ) from error
    return context


def _check_readable(path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read ({error.strerror})") from error


def settings(endpoints: Sequence[Endpoint], options: WireOptions) -> dict[str, Any]:
    """Return the settings of the session, by their paths in Zenoh's configuration."""
    here = [str(endpoint) for endpoint in endpoints]
    chosen: dict[str, Any] = {
        "mode": options.session_mode,
        # An empty list, because the default is to listen on all interfaces.
        "listen/endpoints": here if options.listen else [],
        "connect/endpoints": [] if options.listen else here,
        "listen/exit_on_failure": True,
        "connect/exit_on_failure": True,
        "connect/timeout_ms": round(OPEN_TIMEOUT_S * 1e3),
        "connect/retry": {
            "period_init_ms": _RETRY_MS[0],
            "period_max_ms": _RETRY_MS[1],
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "adminspace/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        # A full queue drops at once: by default each put() would wait for room for 1 ms, and under load for
        # much longer.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    for protocol in ("tcp", "tls"):
        # The kernel would buffer seconds of commands for a peer that hangs. It would then follow them all,
        # oldest first, when it wakes up.
        chosen[f"transport/link/{protocol}/so_sndbuf"] = _BUFFER_BYTES
        chosen[f"transport/link/{protocol}/so_rcvbuf"] = _BUFFER_BYTES
    if any(endpoint.protocol == "tls" for endpoint in endpoints):
        chosen |= _tls_settings(options)
    return chosen


def _tls_settings(options: WireOptions) -> dict[str, Any]:
    own = options.certificate is not None
    files = {
        "root_ca_certificate": options.ca,
        "listen_certificate": options.certificate if options.listen else None,
        "listen_private_key": options.key if options.listen else None,
        "connect_certificate": options.certificate,
        "connect_private_key": options.key,
    }
    named = {name: str(path) for name, path in files.items() if path is not None}
    flags = {"enable_mtls": own, "verify_name_on_connect": True, "close_link_on_expiration": True}
    return {f"transport/link/tls/{name}": value for name, value in (named | flags).items()}


def answering(
    endpoints: Sequence[Endpoint], options: WireOptions, timeout_s: float = PROBE_TIMEOUT_S
) -> tuple[Endpoint, ...]:
    """Return the end points, reachable ones first. Zenoh itself cannot report why one is not reachable.

    A client needs one of them, a peer needs all. ``timeout_s`` is the longest wait for each [s].

    Raises:
        PortNotFoundError: Nothing listens there, or there is no such host.
        TransportTimeoutError: The host does not answer.
    """
    errors = {endpoint: _probe(endpoint, timeout_s) for endpoint in endpoints}
    good = tuple(endpoint for endpoint in endpoints if errors[endpoint] is None)
    bad = tuple(endpoint for endpoint in endpoints if errors[endpoint] is not None)
    error = errors[bad[0]] if bad else None
    if error is not None and (options.session_mode == "peer" or not good):
        raise error
    return good + bad


def _probe(endpoint: Endpoint, timeout_s: float) -> PortNotFoundError | TransportTimeoutError | None:
    if endpoint.protocol == "udp":
        return None
    try:
        socket.create_connection((endpoint.host, endpoint.port), timeout_s).close()
    except TimeoutError:
        return TransportTimeoutError(
            f"{endpoint}: the host did not answer within {timeout_s:g} s; check that it is on, the "
            "address, and the firewall"
        )
    except socket.gaierror as error:
        return PortNotFoundError(f"{endpoint}: there is no host {endpoint.host!r} ({error.strerror})")
    except OSError as error:
        return PortNotFoundError(
            f"{endpoint}: {error.strerror or error}. Start the bridge, or `deal-hw emulate go2 --transport "
            "zenoh`, and check its port"
        )
    return None


def why_no_session(endpoints: Sequence[Endpoint], options: WireOptions) -> str:
    """Return text on why reachable end points give no session."""
    for endpoint in endpoints:
        if endpoint.protocol == "tls":
            return _tls_trouble(endpoint, options)
    return (
        "something listens there, but it is not Zenoh, or it hangs, or it uses the "
        "other protocol of tls/ and tcp/"
    )


def _tls_trouble(endpoint: Endpoint, options: WireOptions) -> str:
    try:
        with (
            socket.create_connection((endpoint.host, endpoint.port), PROBE_TIMEOUT_S) as plain,
            tls_context(options).wrap_socket(plain, server_hostname=endpoint.host) as secure,
        ):
            # A server refuses our certificate only after the handshake.
            secure.settimeout(0.5)
            secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        clock = "; is this computer's clock right?" * (error.verify_code in (_NOT_YET_VALID, _EXPIRED))
        return f"its certificate is not accepted: {error.verify_message}{clock}"
    except TimeoutError:
        return "TLS works, but what listens there does not speak Zenoh"
    except ssl.SSLError as error:
        reason = error.reason or str(error)
        meant = [text for name, text in _ALERTS.items() if name in reason]
        return f"TLS fails: {reason}" + (f"; {meant[0]}" if meant else "")
    except OSError as error:
        return f"TLS fails: {error.strerror or error}"
    return "it closes the connection; it may not accept our certificate"
