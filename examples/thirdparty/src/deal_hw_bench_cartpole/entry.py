"""What deal-hw reads first: where each part of the robot and of the transport is. It imports none of them."""

from __future__ import annotations

from typing import Final

from deal_hw.robots.entry import RobotEntry, TransportEntry, WireEntry

ROBOT: Final = RobotEntry(
    name="bench_cartpole",
    # The version of the entry's fields that this file was written for: a number, not deal-hw's own constant.
    api_version=1,
    driver="deal_hw_bench_cartpole.robot:BenchCartpole",
    wires=(
        WireEntry(
            name="serial",
            transport="serial",
            # The port has another baud rate than deal-hw's usual one, so the driver opens it itself.
            driver="deal_hw_bench_cartpole.robot:serial_robot",
            opens_port=True,
            emulator="deal_hw_bench_cartpole.emulator:emulator",
        ),
        # The same bytes through a serial server such as ser2net.
        WireEntry(name="tcp", transport="tcp"),
    ),
    spaces="deal_hw_bench_cartpole.description:SPACES",
    task="deal_hw_bench_cartpole.swing_up:SWING_UP",
    policy="deal_hw_bench_cartpole:assets/swing_up.onnx",
)

TCP: Final = TransportEntry(
    name="tcp",
    api_version=1,
    transport="deal_hw_bench_cartpole.tcp_transport:TcpTransport",
    adopt="deal_hw_bench_cartpole.tcp_transport:TcpTransport.from_fd",
    local="deal_hw_bench_cartpole.tcp_transport:is_local",
)
