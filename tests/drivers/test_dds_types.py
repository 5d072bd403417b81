"""The DDS types are the robot's own: same hashes, same bytes."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from deal_hw.drivers.transports.dds_types import (
    COMPLETE,
    MINIMAL,
    STRUCTS,
    UINT8,
    build_types,
    check_types,
    load_types,
    type_hashes,
)
from deal_hw.drivers.transports.topics import HUMANOID_TYPES, TYPES
from deal_hw.errors import VersionMismatchError

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"
)
IDL = Path(__file__).resolve().parent / "peer_0102/go2_messages.idl"
WORDS = {
    "octet": "octet",
    "boolean": "boolean",
    "string": "string",
    "float": "float32",
    "short": "int16",
    "unsigned short": "uint16",
    "long": "int32",
    "unsigned long": "uint32",
    "long long": "int64",
    "sequence<octet>": "sequence<octet>",
}


def as_uint8(structs: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Return the table as somebody would declare it who takes an octet for a uint8."""
    return {
        name: {field: text.replace("octet", "uint8") for field, text in fields.items()}
        for name, fields in structs.items()
    }


def test_every_topic_has_a_type() -> None:
    """What can be declared can be opened."""
    assert {*TYPES.values(), *HUMANOID_TYPES.values()} == set(MINIMAL) == set(COMPLETE) == set(load_types())


@pytest.mark.parametrize("name", MINIMAL)
def test_hashes_are_the_robots(name: str) -> None:
    """Minimal as in the vendor's C++ headers, complete as its peers show them in discovery."""
    assert type_hashes(load_types()[name]) == (MINIMAL[name], COMPLETE[name])


def test_octets_declared_as_uint8_are_refused() -> None:
    """The naive declaration, which crashes Cyclone DDS 0.10.2, has other hashes, and the error says so."""
    naive = build_types(as_uint8(STRUCTS))
    assert {name: type_hashes(naive[name])[1] for name in UINT8} == dict(UINT8)
    with pytest.raises(VersionMismatchError, match=r"LowCmd_ has .*, the robot 832876ce.*6569fc15.*crash"):
        check_types(naive)


@pytest.mark.parametrize(("field", "text"), [("level_flag", "int16"), ("crc", "int32"), ("gpio", "octet[2]")])
def test_a_field_of_another_type_is_refused(field: str, text: str) -> None:
    """Only the type that was changed is named."""
    name = "unitree_go::msg::dds_::LowCmd_"
    with pytest.raises(VersionMismatchError) as caught:
        check_types(build_types({**STRUCTS, name: {**STRUCTS[name], field: text}}))
    assert "LowCmd_ has" in str(caught.value)
    assert "LowState_" not in str(caught.value)


def test_fields_in_another_order_are_refused() -> None:
    """The same fields, turned round, are another message."""
    name = "unitree_go::msg::dds_::WirelessController_"
    turned = dict(reversed(list(STRUCTS[name].items())))
    with pytest.raises(VersionMismatchError, match="WirelessController_"):
        check_types(build_types({**STRUCTS, name: turned}))


def test_the_table_says_what_the_idl_of_the_test_peer_says() -> None:
    """Two hands wrote them; field by field they agree."""
    text = re.sub(r"//[^\n]*", "", IDL.read_text())
    found = {}
    for part in re.split(r"module (?=unitree_)", text)[1:]:
        scope = f"{part.split()[0]}::msg::dds_::"
        for struct, body in re.findall(r"struct (\w+) \{(.*?)\}", part, re.DOTALL):
            fields = re.findall(r"([\w<> ]+?) (\w+)(\[\d+\])?;", " ".join(body.split()))
            kinds = [(kind.strip(), name, size) for kind, name, size in fields]
            found[scope + struct] = {name: WORDS.get(kind, scope + kind) + size for kind, name, size in kinds}
    assert found == {name: dict(fields) for name, fields in STRUCTS.items()}
