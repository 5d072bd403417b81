"""Zenoh over TLS: certificates of one authority let each other in, others do not."""

from __future__ import annotations

import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.errors import ConfigurationError, PortNotFoundError
from deal_hw.testing.transport_suite import TopicPair, meet
from deal_hw.transport import WireOptions

IMPATIENT = {"connect/timeout_ms": 500}
"""Setting of a session that never comes, so that nobody waits long for it."""

COMMAND, STATE = "rt/lowcmd", "rt/lowstate"
pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(
        shutil.which("openssl") is None, reason="makes certificates with the command openssl; install openssl"
    ),
]


def openssl(*arguments: object) -> None:
    """Run the command."""
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def make_ca(folder: Path, name: str) -> Path:
    """Make an authority as docs/how-to/go2-zenoh.md does; return its certificate, its key lies beside it."""
    openssl(
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-days",
        30,
        "-subj",
        f"/CN={name}",
        "-keyout",
        folder / f"{name}.key",
        "-out",
        folder / f"{name}.pem",
        "-addext",
        "basicConstraints=critical,CA:TRUE",
        "-addext",
        "keyUsage=critical,keyCertSign,cRLSign",
    )
    return folder / f"{name}.pem"


def make_certificate(ca: Path, name: str, address: str) -> WireOptions:
    """Make a certificate for an address, signed by the authority, and return the options that use it."""
    folder = ca.parent
    key, request, certificate = (folder / f"{name}.{end}" for end in ("key", "csr", "pem"))
    openssl(
        "req",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-subj",
        f"/CN={name}",
        "-keyout",
        key,
        "-out",
        request,
    )
    (folder / f"{name}.ext").write_text(
        f"subjectAltName=IP:{address}\nextendedKeyUsage=serverAuth,clientAuth\nbasicConstraints=CA:FALSE\n"
    )
    openssl(
        "x509",
        "-req",
        "-days",
        30,
        "-in",
        request,
        "-CA",
        ca,
        "-CAkey",
        ca.with_suffix(".key"),
        "-CAcreateserial",
        "-extfile",
        folder / f"{name}.ext",
        "-out",
        certificate,
    )
    return WireOptions(ca=ca, certificate=certificate, key=key)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WireOptions]:
    """Return options by who uses them."""
    folder = tmp_path_factory.mktemp("tls")
    ca, other = make_ca(folder, "ca"), make_ca(folder, "other_ca")
    strange = make_certificate(other, "stranger", "127.0.0.1")
    return {
        "robot": make_certificate(ca, "robot", "127.0.0.1"),
        "controller": make_certificate(ca, "controller", "127.0.0.1"),
        "elsewhere": make_certificate(ca, "elsewhere", "192.168.123.18"),
        # It knows the authority of the robot, but was signed by another.
        "stranger": WireOptions(ca=ca, certificate=strange.certificate, key=strange.key),
        "nobody": WireOptions(ca=ca),
        "deceived": WireOptions(ca=other, certificate=strange.certificate, key=strange.key),
    }


@pytest.fixture
def endpoint() -> str:
    """Return an end point that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tls/127.0.0.1:{probe.getsockname()[1]}"


def listening(options: WireOptions) -> WireOptions:
    """Return the options of the side that waits."""
    return WireOptions(listen=True, ca=options.ca, certificate=options.certificate, key=options.key)


def test_both_ends_with_certificates_of_one_authority_talk(
    files: dict[str, WireOptions], endpoint: str
) -> None:
    """Commands and states pass."""
    near = ZenohTransport(endpoint, options=listening(files["robot"]))
    far = ZenohTransport(endpoint, options=files["controller"])
    near.declare(publish=[STATE], subscribe=[COMMAND])
    far.declare(publish=[COMMAND], subscribe=[STATE])
    with near, far:
        meet(TopicPair(near=near, far=far, down=STATE, up=COMMAND, payload=lambda topic, n: bytes([n]) * 812))


@pytest.mark.parametrize(
    ("robot", "controller", "words"),
    [
        ("robot", "stranger", "certificate|ALERT"),
        ("robot", "nobody", "--certificate and --key"),
        ("robot", "deceived", "its certificate is not accepted"),
        ("elsewhere", "controller", "its certificate is not accepted: .*127.0.0.1"),
    ],
)
def test_others_get_no_session_and_are_told_why(
    files: dict[str, WireOptions], endpoint: str, robot: str, controller: str, words: str
) -> None:
    """A foreign or absent certificate, a foreign authority, a certificate for another address."""
    with ZenohTransport(endpoint, options=listening(files[robot])):
        with pytest.raises(PortNotFoundError, match=words):
            ZenohTransport(endpoint, options=files[controller], settings=IMPATIENT).open()


def test_plain_text_finds_no_session_where_tls_listens(files: dict[str, WireOptions], endpoint: str) -> None:
    """Who forgets TLS gets a message that the protocol may be the reason."""
    with ZenohTransport(endpoint, options=listening(files["robot"])):
        with pytest.raises(PortNotFoundError, match="uses the other protocol of tls/ and tcp/"):
            ZenohTransport(endpoint.replace("tls", "tcp"), settings=IMPATIENT).open()


def test_a_key_of_another_certificate_is_refused(files: dict[str, WireOptions], endpoint: str) -> None:
    """The mix-up is found before any connection."""
    robot, controller = files["robot"], files["controller"]
    mixed = WireOptions(ca=robot.ca, certificate=robot.certificate, key=controller.key)
    with pytest.raises(ConfigurationError, match=r"robot\.pem and .*controller\.key are no certificate"):
        ZenohTransport(endpoint, options=mixed).open()


def test_an_encrypted_key_is_refused_without_asking_the_terminal(
    files: dict[str, WireOptions], endpoint: str, tmp_path: Path
) -> None:
    """Zenoh could not read it, either."""
    robot = files["robot"]
    openssl("ec", "-in", robot.key, "-aes256", "-passout", "pass:secret", "-out", tmp_path / "locked.key")
    locked = WireOptions(ca=robot.ca, certificate=robot.certificate, key=tmp_path / "locked.key")
    with pytest.raises(ConfigurationError, match="unencrypted"):
        ZenohTransport(endpoint, options=locked).open()
