"""DDS types of Unitree's robots, and a check that they equal the robots'.

XTypes gives each type a hash, and peers compare the hashes during discovery. There are three reasons to check
them before a domain is opened:

- Unitree's IDL says ``octet``. cyclonedds-python 11 turns a field declared ``types.uint8`` into another kind
  (TK_UINT8 instead of TK_BYTE). The hash then differs, and the peer asks for the type's description. The
  robot runs Cyclone DDS 0.10.2, which crashes with a segmentation fault when it reads that kind
  (eclipse-cyclonedds/cyclonedds#1554). So octets are declared ``types.byte`` here.
- A field in the wrong order gives another hash; then no messages are exchanged, without an error.
- The Python binding computes the hashes, so another version of it could change them.

:data:`MINIMAL` are the hashes in the headers of unitree_sdk2 @ 21d0a3b. For the IDL of the test peer
(``tests/drivers/peer_0102``), idlc 0.10.2 gives the same, and :data:`COMPLETE` too.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from deal_hw.errors import MissingExtraError, VersionMismatchError
from deal_hw.install import install_line

_GO: Final = "unitree_go::msg::dds_::"
_HG: Final = "unitree_hg::msg::dds_::"
_API: Final = "unitree_api::msg::dds_::"

_FRAME: Final = {
    "head": "octet[2]",
    "level_flag": "octet",
    "frame_reserve": "octet",
    "sn": "uint32[2]",
    "version": "uint32[2]",
    "bandwidth": "uint16",
}

STRUCTS: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        f"{_GO}MotorCmd_": {
            "mode": "octet",
            **dict.fromkeys(("q", "dq", "tau", "kp", "kd"), "float32"),
            "reserve": "uint32[3]",
        },
        f"{_GO}BmsCmd_": {"off": "octet", "reserve": "octet[3]"},
        f"{_GO}LowCmd_": {
            **_FRAME,
            "motor_cmd": f"{_GO}MotorCmd_[20]",
            "bms_cmd": f"{_GO}BmsCmd_",
            "wireless_remote": "octet[40]",
            "led": "octet[12]",
            "fan": "octet[2]",
            "gpio": "octet",
            "reserve": "uint32",
            "crc": "uint32",
        },
        f"{_GO}IMUState_": {
            "quaternion": "float32[4]",
            "gyroscope": "float32[3]",
            "accelerometer": "float32[3]",
            "rpy": "float32[3]",
            "temperature": "octet",
        },
        f"{_GO}MotorState_": {
            "mode": "octet",
            **dict.fromkeys(("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw"), "float32"),
            "temperature": "octet",
            "lost": "uint32",
            "reserve": "uint32[2]",
        },
        f"{_GO}BmsState_": {
            **dict.fromkeys(("version_high", "version_low", "status", "soc"), "octet"),
            "current": "int32",
            "cycle": "uint16",
            "bq_ntc": "octet[2]",
            "mcu_ntc": "octet[2]",
            "cell_vol": "uint16[15]",
        },
        f"{_GO}LowState_": {
            **_FRAME,
            "imu_state": f"{_GO}IMUState_",
            "motor_state": f"{_GO}MotorState_[20]",
            "bms_state": f"{_GO}BmsState_",
            "foot_force": "int16[4]",
            "foot_force_est": "int16[4]",
            "tick": "uint32",
            "wireless_remote": "octet[40]",
            "bit_flag": "octet",
            "adc_reel": "float32",
            "temperature_ntc1": "octet",
            "temperature_ntc2": "octet",
            "power_v": "float32",
            "power_a": "float32",
            "fan_frequency": "uint16[4]",
            "reserve": "uint32",
            "crc": "uint32",
        },
        f"{_GO}TimeSpec_": {"sec": "int32", "nanosec": "uint32"},
        f"{_GO}PathPoint_": dict.fromkeys(("t_from_start", "x", "y", "yaw", "vx", "vy", "vyaw"), "float32"),
        f"{_GO}SportModeState_": {
            "stamp": f"{_GO}TimeSpec_",
            "error_code": "uint32",
            "imu_state": f"{_GO}IMUState_",
            "mode": "octet",
            "progress": "float32",
            "gait_type": "octet",
            "foot_raise_height": "float32",
            "position": "float32[3]",
            "body_height": "float32",
            "velocity": "float32[3]",
            "yaw_speed": "float32",
            "range_obstacle": "float32[4]",
            "foot_force": "int16[4]",
            "foot_position_body": "float32[12]",
            "foot_speed_body": "float32[12]",
            "path_point": f"{_GO}PathPoint_[10]",
        },
        f"{_GO}WirelessController_": {
            **dict.fromkeys(("lx", "ly", "rx", "ry"), "float32"),
            "keys": "uint16",
        },
        f"{_HG}MotorCmd_": {
            "mode": "octet",
            **dict.fromkeys(("q", "dq", "tau", "kp", "kd"), "float32"),
            "reserve": "uint32",
        },
        f"{_HG}LowCmd_": {
            "mode_pr": "octet",
            "mode_machine": "octet",
            "motor_cmd": f"{_HG}MotorCmd_[35]",
            "reserve": "uint32[4]",
            "crc": "uint32",
        },
        f"{_HG}IMUState_": {
            "quaternion": "float32[4]",
            "gyroscope": "float32[3]",
            "accelerometer": "float32[3]",
            "rpy": "float32[3]",
            "temperature": "int16",
        },
        f"{_HG}MotorState_": {
            "mode": "octet",
            **dict.fromkeys(("q", "dq", "ddq", "tau_est"), "float32"),
            "temperature": "int16[2]",
            "vol": "float32",
            "sensor": "uint32[2]",
            "motorstate": "uint32",
            "reserve": "uint32[4]",
        },
        f"{_HG}LowState_": {
            "version": "uint32[2]",
            "mode_pr": "octet",
            "mode_machine": "octet",
            "tick": "uint32",
            "imu_state": f"{_HG}IMUState_",
            "motor_state": f"{_HG}MotorState_[35]",
            "wireless_remote": "octet[40]",
            "reserve": "uint32[4]",
            "crc": "uint32",
        },
        f"{_API}RequestIdentity_": {"id": "int64", "api_id": "int64"},
        f"{_API}RequestLease_": {"id": "int64"},
        f"{_API}RequestPolicy_": {"priority": "int32", "noreply": "boolean"},
        f"{_API}RequestHeader_": {
            "identity": f"{_API}RequestIdentity_",
            "lease": f"{_API}RequestLease_",
            "policy": f"{_API}RequestPolicy_",
        },
        f"{_API}Request_": {
            "header": f"{_API}RequestHeader_",
            "parameter": "string",
            "binary": "sequence<octet>",
        },
        f"{_API}ResponseStatus_": {"code": "int32"},
        f"{_API}ResponseHeader_": {
            "identity": f"{_API}RequestIdentity_",
            "status": f"{_API}ResponseStatus_",
        },
        f"{_API}Response_": {
            "header": f"{_API}ResponseHeader_",
            "data": "string",
            "binary": "sequence<octet>",
        },
    }
)
"""Struct -> field -> type, named as in IDL; a struct comes after those that it contains."""

MINIMAL: Final[Mapping[str, str]] = MappingProxyType(
    {
        f"{_GO}LowCmd_": "832876ceec9737d69f6ed62a3f63",
        f"{_GO}LowState_": "853a99e23d0daa1610b65c526b40",
        f"{_HG}LowCmd_": "6569fc15f0d47aa8600b9e91fbbc",
        f"{_HG}LowState_": "2f38296b52aa0230b92d378b1e39",
        f"{_GO}SportModeState_": "9fa6ccdc5cafdeaab8a762e31044",
        f"{_GO}WirelessController_": "d8dc69fff5d75961cd0e3fc049cb",
        f"{_API}Request_": "cba4dc965d393ada76b4de081925",
        f"{_API}Response_": "48c997d379c3e18c530b5f8fe946",
    }
)
"""Type -> hash of its minimal TypeIdentifier; the types that travel as messages."""

COMPLETE: Final[Mapping[str, str]] = MappingProxyType(
    {
        f"{_GO}LowCmd_": "52cc8eb0d427d692aa2b20a90540",
        f"{_GO}LowState_": "08f239c471d3a27e67e7c7723184",
        f"{_HG}LowCmd_": "42b0283aa7e1bb592ec898a0dbed",
        f"{_HG}LowState_": "2be9706c9587e8d8afd8bfc6de7b",
        f"{_GO}SportModeState_": "e59749630fff75cc170afb238783",
        f"{_GO}WirelessController_": "e9686fe76f7b08f92cb24943ac72",
        f"{_API}Request_": "c47a4429fcbf539486498753c48f",
        f"{_API}Response_": "d1c32cc02214901a464a6c51325d",
    }
)
"""Type -> hash of its complete TypeIdentifier, which discovery shows of each peer."""

UINT8: Final[Mapping[str, str]] = MappingProxyType(
    {
        f"{_GO}LowCmd_": "12da99179559f14db8b7ab23acdd",
        f"{_GO}LowState_": "ef1819d05896c24741d6dbde9167",
        f"{_HG}LowCmd_": "ef636a54656de1d49ca65377b07c",
        f"{_HG}LowState_": "860cfa7cbdcd87fbdb066de53c1d",
        f"{_GO}SportModeState_": "4014d13a03d68f246f38f1449cb2",
    }
)
"""The same for types whose octets were declared uint8: a peer that shows one can crash the robot."""


@functools.cache
def load_types() -> Mapping[str, Any]:
    """Return the message types as classes of cyclonedds, by DDS name, with their hashes checked.

    Raises:
        MissingExtraError: cyclonedds is not installed.
        VersionMismatchError: A hash is not the robot's.
    """
    types = build_types(STRUCTS)
    check_types(types)
    return MappingProxyType({name: types[name] for name in MINIMAL})


def build_types(structs: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return a cyclonedds class for each struct of a table like :data:`STRUCTS`.

    Raises:
        MissingExtraError: cyclonedds is not installed.
    """
    try:
        from cyclonedds import idl
    except ImportError as error:
        raise MissingExtraError("cyclonedds", "dds") from error
    types: Any = idl.types
    plain = ("int16", "int32", "int64", "uint8", "uint16", "uint32", "float32", "float64")
    known: dict[str, Any] = {name: getattr(types, name) for name in plain}
    # `octet` is types.byte, never types.uint8: see the top of this file.
    known |= {"octet": types.byte, "boolean": bool, "string": str}
    for name, fields in structs.items():
        made = {field: _field(types, known, text) for field, text in fields.items()}
        known[name] = idl.make_idl_struct(name.rpartition("::")[2], name.replace("::", "."), made)
    return {name: known[name] for name in structs}


def _field(types: Any, known: Mapping[str, Any], text: str) -> Any:
    if text.startswith("sequence<"):
        return types.sequence[known[text.removeprefix("sequence<").removesuffix(">")]]
    element, _, size = text.rstrip("]").partition("[")
    return types.array[known[element], int(size)] if size else known[element]


def type_hashes(made: Any) -> tuple[str, str]:
    """Return the minimal and the complete hash of a class of cyclonedds, in hexadecimal."""
    info = made.__idl__.get_type_info()
    return hash_text(info.minimal.typeid_with_size.type_id), hash_text(info.complete.typeid_with_size.type_id)


def hash_text(identifier: Any) -> str:
    """Return the hash in a TypeIdentifier in hexadecimal, "" if there is none."""
    value = getattr(identifier, "value", None)
    return bytes(value).hex() if isinstance(value, bytes | bytearray | list | tuple) else ""


def check_types(types: Mapping[str, Any]) -> None:
    """Compare the hashes of types with those of the robot's.

    Raises:
        VersionMismatchError: They differ.
    """
    found = {name: type_hashes(types[name]) for name in MINIMAL}
    wrong = [
        f"{name} has {minimal}/{complete}, the robot {MINIMAL[name]}/{COMPLETE[name]}"
        for name, (minimal, complete) in found.items()
        if minimal != MINIMAL[name] or complete != COMPLETE[name]
    ]
    if wrong:
        raise VersionMismatchError(
            f"DDS types differ from the robot's (XTypes hashes): {'; '.join(wrong)}. Opening the domain "
            "could crash the robot's DDS process, so it stays closed. Was another cyclonedds installed? "
            f"{install_line('dds')} brings the version that was checked"
        )
