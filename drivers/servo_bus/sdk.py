"""The only module that imports ROBOTIS' SDK; if it is missing, its error names the extra to install."""

from __future__ import annotations

from deal_hw.errors import MissingExtraError

try:
    from dynamixel_easy_sdk.control_table import ControlTable
    from dynamixel_easy_sdk.dynamixel_error import DxlRuntimeError
    from dynamixel_sdk import COMM_SUCCESS, PacketHandler
    from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
except ImportError as err:
    raise MissingExtraError("dynamixel-sdk", "dynamixel") from err

__all__ = ["COMM_SUCCESS", "ControlTable", "DxlRuntimeError", "PacketHandler", "Protocol2PacketHandler"]
