"""Topics of Unitree's robots, and their types; where robots differ, the Go2's.

Names are those of DDS, without a leading slash; zenoh-bridge-dds uses them as keys unchanged. Source:
unitree_sdk2_python @ 37116c5 and unitree_ros2 @ eea2719.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from deal_hw.errors import UnknownNameError

LOW_COMMAND: Final = "rt/lowcmd"
LOW_STATE: Final = "rt/lowstate"
LOW_STATE_SLOW: Final = "rt/lf/lowstate"
SPORT_STATE: Final = "rt/sportmodestate"
SPORT_STATE_SLOW: Final = "rt/lf/sportmodestate"
WIRELESS: Final = "rt/wirelesscontroller"

CLAIM: Final = "rt/deal_hw/claim"
"""Claim of the program that commands the robot, for other deal-hw programs; the robot ignores it. The type is
a request's."""

BRIDGE: Final = "rt/deal_hw/bridge"
"""Owner of the robot, from deal-hw's bridge to its clients. The type is a request's."""

SERVICES: Final = ("motion_switcher", "sport", "robot_state")
"""Services that answer requests: motion switcher, the vendor's gaits, robot state."""


def request(service: str) -> str:
    """Return the topic of a service's requests.

    Raises:
        UnknownNameError: There is no such service.
    """
    return f"rt/api/{_known(service)}/request"


def response(service: str) -> str:
    """Return the topic of a service's responses.

    Raises:
        UnknownNameError: There is no such service.
    """
    return f"rt/api/{_known(service)}/response"


def _known(service: str) -> str:
    if service not in SERVICES:
        raise UnknownNameError("Go2 service", service, SERVICES)
    return service


TYPES: Final[Mapping[str, str]] = {
    LOW_COMMAND: "unitree_go::msg::dds_::LowCmd_",
    LOW_STATE: "unitree_go::msg::dds_::LowState_",
    LOW_STATE_SLOW: "unitree_go::msg::dds_::LowState_",
    SPORT_STATE: "unitree_go::msg::dds_::SportModeState_",
    SPORT_STATE_SLOW: "unitree_go::msg::dds_::SportModeState_",
    WIRELESS: "unitree_go::msg::dds_::WirelessController_",
    CLAIM: "unitree_api::msg::dds_::Request_",
    BRIDGE: "unitree_api::msg::dds_::Request_",
    **{request(service): "unitree_api::msg::dds_::Request_" for service in SERVICES},
    **{response(service): "unitree_api::msg::dds_::Response_" for service in SERVICES},
}
"""Topic -> name of its DDS type."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TypedTopics:
    """Topics of ROS 2, of which a transport knows nothing by itself.

    Attributes:
        types: Topic, as on the wire of DDS -> DDS name of its type.
        structs: Struct -> field -> type, as in :mod:`dds_types`; a struct comes after those that it contains.
        hashes: DDS name of a type -> ROS 2's hash of it, which writers and readers announce.
    """

    types: Mapping[str, str]
    structs: Mapping[str, Mapping[str, str]]
    hashes: Mapping[str, str] = field(default_factory=dict)


HUMANOID_TYPES: Final[Mapping[str, str]] = {
    LOW_COMMAND: "unitree_hg::msg::dds_::LowCmd_",
    LOW_STATE: "unitree_hg::msg::dds_::LowState_",
    LOW_STATE_SLOW: "unitree_hg::msg::dds_::LowState_",
}
"""The same for the G1 where it differs."""
