"""``deal-hw keys``: what is made, with which permissions, and what is reported of it."""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import pytest

from deal_hw.cli.keys import Add, Make, Show, keys, make
from deal_hw.cli.main import main
from deal_hw.drivers.transports import certificates
from deal_hw.drivers.transports.certificates import read_certificate, sign
from deal_hw.drivers.transports.zenoh_session import own_certificate_trouble
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.install import install_line
from deal_hw.transport import WireOptions

pytest.importorskip("cryptography", reason="pip install 'deal-hw[keys]'")
NOW = datetime.datetime.now(datetime.timezone.utc)
DAY = datetime.timedelta(days=1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with an authority, a robot, a controller and an observer."""
    make(Make(out=tmp_path / "keys", robot=("192.168.1.20", "dog.local")), NOW)
    return tmp_path / "keys"


def options(folder: Path, name: str) -> WireOptions:
    """Return what a client with this certificate gives."""
    return WireOptions(ca=folder / "ca.pem", certificate=folder / f"{name}.pem", key=folder / f"{name}.key")


def test_keys_are_private_and_certificates_fit(folder: Path) -> None:
    """Each key is 0600 in a folder of 0700; each certificate is accepted by the authority."""
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.name for path in folder.glob("*.key")} == {
        "ca.key",
        "robot.key",
        "controller.key",
        "observer.key",
    }
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in folder.glob("*.key"))
    for name in ("robot", "controller", "observer"):
        assert own_certificate_trouble(options(folder, name)) == (0, "")
        found = read_certificate(folder / f"{name}.pem")
        assert (found.name, found.authority) == (name, False)
        assert found.issuer == read_certificate(folder / "ca.pem").name
    assert read_certificate(folder / "robot.pem").addresses == ("192.168.1.20", "dog.local")


def test_nothing_is_overwritten(folder: Path) -> None:
    """Neither an authority nor a certificate; the files stay as they were."""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ConfigurationError, match=r"ca\.pem exists and is not overwritten"):
        make(Make(out=folder, robot=("10.0.0.1",)), NOW)
    with pytest.raises(ConfigurationError, match=r"controller\.pem exists"):
        sign(folder, "controller", addresses=(), days=1, now=NOW)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_show_tells_names_and_days_left(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And what needs attention: expired, soon to expire, not valid yet, a key that others can read."""
    assert keys(Show(folder=folder)) == 0
    sign(folder, "old", addresses=(), days=1, now=NOW - 3 * DAY)
    sign(folder, "soon", addresses=(), days=10, now=NOW)
    sign(folder, "early", addresses=(), days=10, now=NOW + 5 * DAY)
    (folder / "controller.key").chmod(0o644)
    (folder / "observer.key").unlink()
    capsys.readouterr()
    assert keys(Show(folder=folder)) == 1
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "authority; 36" in lines["ca.pem"]
    assert "for 192.168.1.20, dog.local; 82" in lines["robot.pem"]
    assert "mode 0644: others can read it, chmod 600" in lines["controller.pem"]
    assert "no key here" in lines["observer.pem"]
    assert "EXPIRED on" in lines["old.pem"]
    assert "9 days left" in lines["soon.pem"] or "10 days left" in lines["soon.pem"]
    assert "renew it soon" in lines["soon.pem"]
    assert "NOT VALID before" in lines["early.pem"]


def test_the_command_makes_adds_and_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As typed; the lines to copy name the files that were made."""
    out = str(tmp_path / "k")
    assert main(["keys", "make", "--out", out, "--robot", "10.0.0.7", "--controllers", "desk", "lab"]) == 0
    printed = capsys.readouterr().out
    assert "bridge go2 --port eth0 --listen tls/10.0.0.7:7447 --ca ca.pem --certificate robot.pem" in printed
    assert "--certificate desk.pem --key desk.key" in printed
    assert main(["keys", "add", out, "bench", "--days", "10"]) == 0
    assert "renew it soon" in capsys.readouterr().out
    assert (tmp_path / "k" / "bench.key").stat().st_mode & 0o777 == 0o600
    assert main(["keys", "show", out]) == 0


def test_a_certificate_does_not_outlive_its_authority(tmp_path: Path) -> None:
    """It would be refused then, and nobody would know why."""
    make(Make(out=tmp_path, robot=("10.0.0.1",), authority_days=5, days=100), NOW)
    ends = {read_certificate(path).expires for path in tmp_path.glob("*.pem")}
    assert len(ends) == 1


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (Make(out=Path("k"), robot=()), "at least one address"),
        (Make(out=Path("k"), robot=("tls/10.0.0.1:7447",)), "an IP address such as"),
        (Make(out=Path("k"), robot=("10.0.0.1",), controllers=("a", "a")), "a name of its own"),
        (Make(out=Path("k"), robot=("10.0.0.1",), controllers=("../x",)), "small letters"),
        (Make(out=Path("k"), robot=("10.0.0.1",), observers=("ca",)), "small letters"),
        (Add(folder=Path("nothing"), name="desk"), "contains no authority that can sign"),
        (Show(folder=Path("nothing")), "holds no certificates"),
    ],
)
def test_what_cannot_be_made_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: Make | Add | Show, words: str
) -> None:
    """One line that says what is allowed."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=words):
        keys(config)


def test_what_is_no_certificate_is_refused(tmp_path: Path) -> None:
    """The file is named."""
    (tmp_path / "x.pem").write_text("hello")
    with pytest.raises(ConfigurationError, match=r"x\.pem contains no certificate"):
        read_certificate(tmp_path / "x.pem")


def test_without_cryptography_the_extra_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Making needs it; whoever only uses certificates does not."""
    monkeypatch.setitem(__import__("sys").modules, "cryptography", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_line("keys"))):
        sign(folder, "another", addresses=(), days=1, now=NOW)
    assert own_certificate_trouble(options(folder, "controller"))[0] == 0


def test_foreign_and_expired_certificates_are_told_apart(folder: Path, tmp_path: Path) -> None:
    """By OpenSSL's own codes, as a peer would judge them."""
    certificates.make_authority(tmp_path / "other", 10, NOW)
    sign(folder, "old", addresses=(), days=1, now=NOW - 3 * DAY)
    foreign = WireOptions(
        ca=tmp_path / "other" / "ca.pem",
        certificate=folder / "controller.pem",
        key=folder / "controller.key",
    )
    assert own_certificate_trouble(foreign)[1] == "unable to get local issuer certificate"
    assert own_certificate_trouble(options(folder, "old"))[1] == "certificate has expired"
    assert own_certificate_trouble(WireOptions(ca=folder / "ca.pem")) == (0, "")
