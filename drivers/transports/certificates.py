"""Certificates for Zenoh over TLS: your own authority, and the certificates that it signs.

Making them needs the package cryptography; using them does not (:mod:`zenoh_session`).
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deal_hw.errors import ConfigurationError, MissingExtraError, short

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

AUTHORITY: Final = "ca"
"""Name of the authority's files."""
BACKDATED: Final = datetime.timedelta(days=1)
"""Certificates are valid from a day before they are made, since the robot's clock may be behind."""
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}")
_SECRET, _PUBLIC = 0o600, 0o644


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """The contents of a certificate.

    Attributes:
        path: Its file.
        name: Common name, by which access is granted.
        addresses: Addresses and host names that it is valid for.
        authority: Whether it may sign others.
        issuer: Common name of the signer.
        begins: Start of its validity, UTC.
        expires: End of its validity, UTC.
        key: Its private key beside it, or None.
        key_mode: Permissions of that file.
    """

    path: Path
    name: str
    addresses: tuple[str, ...]
    authority: bool
    issuer: str
    begins: datetime.datetime
    expires: datetime.datetime
    key: Path | None
    key_mode: int

    def days_left(self, now: datetime.datetime) -> float:
        """Return the remaining days of validity; negative after its end."""
        return (self.expires - now) / datetime.timedelta(days=1)


def make_authority(folder: Path, days: float, now: datetime.datetime) -> None:
    """Make an authority in a folder: ``ca.pem``, and ``ca.key``, which signs.

    Args:
        folder: The folder; made if missing.
        days: How long it holds.
        now: The time, UTC.

    Raises:
        ConfigurationError: The folder has an authority already.
        MissingExtraError: cryptography is not installed.
    """
    x509 = _x509()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    _refuse_overwriting(folder, AUTHORITY)
    key = _new_key()
    # Two authorities need two names, so that a mix-up of their files gives a clear error.
    name = _common_name(f"deal-hw authority {secrets.token_hex(3)}")
    usage = _usage(key_cert_sign=True, crl_sign=True)
    builder = (
        _builder(name, name, key, days, now)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    _write(folder, AUTHORITY, builder, key, key)


def sign(folder: Path, name: str, *, addresses: Iterable[str], days: float, now: datetime.datetime) -> Path:
    """Make a certificate and its key, signed by the authority of a folder; return the certificate's file.

    Args:
        folder: With ``ca.pem`` and ``ca.key``.
        name: Common name, and name of the files.
        addresses: Where others reach it: IP addresses or host names; none for one that only connects.
        days: How long it holds; no longer than its authority.
        now: The time, UTC.

    Raises:
        ConfigurationError: The name or an address is not valid, the files exist, or there is no authority.
        MissingExtraError: cryptography is not installed.
    """
    x509 = _x509()
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509.oid import ExtendedKeyUsageOID

    if not _NAME.fullmatch(name) or name == AUTHORITY:
        raise ConfigurationError(
            f"certificate name {short(name)!r}: small letters, digits and . _ - (not {AUTHORITY!r}), such as "
            "controller"
        )
    _refuse_overwriting(folder, name)
    try:
        issuer = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.pem").read_bytes())
        signer: Any = load_pem_private_key((folder / f"{AUTHORITY}.key").read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"{folder} contains no authority that can sign ({AUTHORITY}.pem and {AUTHORITY}.key): {error}; "
            "`deal-hw keys make` makes one"
        ) from error
    found = tuple(addresses)
    ends = min(now + datetime.timedelta(days=days), issuer.not_valid_after_utc)
    key = _new_key()
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * bool(found)
    builder = (
        _builder(_common_name(name), issuer.subject, key, (ends - now) / datetime.timedelta(days=1), now)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([_general_name(a) for a in found or (name,)]), critical=False
        )
    )
    _write(folder, name, builder, key, signer)
    return folder / f"{name}.pem"


def read_certificate(path: Path) -> Certificate:
    """Return the contents of a certificate.

    Raises:
        ConfigurationError: The file cannot be read, or contains no certificate.
        MissingExtraError: cryptography is not installed.
    """
    x509 = _x509()
    try:
        found = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path} contains no certificate in PEM form ({error}); name another "
            "file, or make one with `deal-hw keys make`"
        ) from error
    try:
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        addresses = tuple(str(part.value) for part in names)
    except x509.ExtensionNotFound:
        addresses = ()
    try:
        authority = bool(found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca)
    except x509.ExtensionNotFound:
        authority = False
    key = path.with_suffix(".key")
    here = key.exists()
    return Certificate(
        path=path,
        name=_name_of(found.subject),
        addresses=addresses,
        authority=authority,
        issuer=_name_of(found.issuer),
        begins=found.not_valid_before_utc,
        expires=found.not_valid_after_utc,
        key=key if here else None,
        key_mode=key.stat().st_mode & 0o777 if here else 0,
    )


def _x509() -> Any:
    try:
        from cryptography import x509
    except ImportError as error:
        raise MissingExtraError("cryptography", "keys") from error
    return x509


def _name_of(name: x509.Name) -> str:
    from cryptography.x509.oid import NameOID

    return " ".join(str(part.value) for part in name.get_attributes_for_oid(NameOID.COMMON_NAME))


def _common_name(name: str) -> x509.Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _general_name(address: str) -> Any:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    if not _NAME.fullmatch(address.lower()):
        raise ConfigurationError(
            f"address {short(address)!r}: an IP address such as 192.168.123.18, or a host name; no port"
        )
    return x509.DNSName(address)


def _new_key() -> EllipticCurvePrivateKey:
    from cryptography.hazmat.primitives.asymmetric import ec

    return ec.generate_private_key(ec.SECP256R1())


def _usage(**given: bool) -> Any:
    from cryptography import x509

    none = dict.fromkeys(
        (
            "digital_signature",
            "content_commitment",
            "key_encipherment",
            "data_encipherment",
            "key_agreement",
            "key_cert_sign",
            "crl_sign",
            "encipher_only",
            "decipher_only",
        ),
        False,
    )
    return x509.KeyUsage(**(none | given))


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, days: float, now: datetime.datetime
) -> x509.CertificateBuilder:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _refuse_overwriting(folder: Path, name: str) -> None:
    for path in (folder / f"{name}.pem", folder / f"{name}.key"):
        if path.exists():
            raise ConfigurationError(
                f"{path} exists and is not overwritten, since its users would lose access. Choose another "
                "folder or name, or move the file away"
            )


def _write(
    folder: Path,
    name: str,
    builder: x509.CertificateBuilder,
    key: EllipticCurvePrivateKey,
    signer: Any,
) -> None:
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    certificate = builder.sign(signer, hashes.SHA256())
    secret = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for path, data, mode in (
        (folder / f"{name}.key", secret, _SECRET),
        (folder / f"{name}.pem", certificate.public_bytes(Encoding.PEM), _PUBLIC),
    ):
        # Never readable for other users, and never over an existing file.
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
