"""End points of Zenoh: what is read, what is refused, what a session is asked for."""

from __future__ import annotations

import json

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.transports.zenoh_session import Endpoint, check_security, parse_endpoints, settings
from deal_hw.errors import ConfigurationError
from deal_hw.transport import WireOptions

pytestmark = pytest.mark.real_time

HOSTS = st.one_of(
    st.ip_addresses(v=4).map(str),
    st.ip_addresses(v=6).map(str),
    st.from_regex(r"[a-z][a-z0-9-]{0,20}(\.[a-z]{1,8})?", fullmatch=True),
)
ENDPOINTS = st.builds(Endpoint, st.sampled_from(["tcp", "udp", "tls"]), HOSTS, st.integers(1, 65535))


@given(st.lists(ENDPOINTS, min_size=1, max_size=4))
def test_end_points_are_read_back_as_written(endpoints: list[Endpoint]) -> None:
    """Names, IPv4 and IPv6 addresses, one or several."""
    assert parse_endpoints(", ".join(map(str, endpoints))) == tuple(endpoints)


@given(st.text(max_size=40))
def test_any_text_is_end_points_or_a_configuration_error(text: str) -> None:
    """What is accepted means what it says."""
    try:
        endpoints = parse_endpoints(text)
    except ConfigurationError:
        return
    assert ",".join(map(str, endpoints)) == ",".join(part.strip() for part in text.split(","))


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.123.18", False),
        ("localhost.example.com", False),
        ("robot", False),
    ],
)
def test_only_what_stays_on_this_machine_needs_no_tls(host: str, loopback: bool) -> None:
    """The wildcard addresses reach everybody; a name may be anybody's."""
    endpoint = Endpoint("tcp", host, 7447)
    assert endpoint.loopback is loopback
    check_security([endpoint], WireOptions(insecure=True))
    if loopback:
        check_security([endpoint], WireOptions())
    else:
        with pytest.raises(ConfigurationError, match="--insecure"):
            check_security([endpoint], WireOptions())


@pytest.mark.parametrize("listen", [True, False])
def test_zenoh_accepts_every_setting_and_neither_calls_nor_listens_around(listen: bool) -> None:
    """The configuration, read back from Zenoh: named end points on one side, no discovery, no admin space."""
    config = zenoh.Config()
    chosen = settings(parse_endpoints("tcp/127.0.0.1:7447"), WireOptions(listen=listen))
    for key, value in chosen.items():
        config.insert_json5(key, json.dumps(value))
        assert json.loads(config.get_json(key)) == value
    here = ["tcp/127.0.0.1:7447"]
    assert json.loads(config.get_json("listen/endpoints")) == (here if listen else [])
    assert json.loads(config.get_json("connect/endpoints")) == ([] if listen else here)
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled", "adminspace/enabled"):
        assert json.loads(config.get_json(key)) is False
