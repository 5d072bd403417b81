"""The robots and transports of deal-hw."""

from __future__ import annotations

from typing import Final

from deal_hw.robots.entry import API_VERSION, RobotEntry, TransportEntry, WireEntry

TRANSPORTS: Final = (
    TransportEntry(
        name="serial",
        api_version=API_VERSION,
        transport="deal_hw.drivers.transports.serial_transport:SerialTransport",
        adopt="deal_hw.drivers.transports.serial_transport:SerialTransport.from_fd",
        claim="deal_hw.robots.ports:path_claim",
        local="deal_hw.robots.ports:path_is_local",
    ),
    TransportEntry(
        name="can",
        api_version=API_VERSION,
        transport="deal_hw.drivers.transports.can_transport:open_can",
        adopt="deal_hw.drivers.transports.can_transport:adopt_can",
        claim="deal_hw.robots.ports:can_claim",
        local="deal_hw.robots.ports:can_is_local",
        needs="deal-hw[can]",
    ),
    TransportEntry(
        name="dds",
        api_version=API_VERSION,
        transport="deal_hw.drivers.transports.dds_transport:DdsTransport",
        topics=True,
        options=("domain",),
        claim="deal_hw.robots.ports:dds_claim",
        local="deal_hw.robots.ports:dds_is_local",
        needs="deal-hw[dds]",
    ),
    TransportEntry(
        name="zenoh",
        api_version=API_VERSION,
        transport="deal_hw.drivers.transports.zenoh_transport:ZenohTransport",
        topics=True,
        options=("listen", "mode", "insecure", "ca", "certificate", "key"),
        claim="deal_hw.robots.ports:zenoh_claim",
        local="deal_hw.robots.ports:zenoh_is_local",
        needs="deal-hw[zenoh]",
    ),
)


def _unitree_wires(claim: str, doctor: str, *, emulated: bool = True) -> tuple[WireEntry, ...]:
    """Return the wires of a robot of Unitree.

    Args:
        claim: Its claim.
        doctor: Its doctor.
        emulated: Whether it has an emulator of its own; a Go2 on its stand is ``emulate go2 --on-stand``.
    """
    return tuple(
        WireEntry(
            name=name,
            transport=name,
            emulator="deal_hw.drivers.unitree.emulator:UnitreeEmulator" if emulated else "",
            emulator_port=port if emulated else "",
            claim=claim,
            doctor=doctor,
        )
        for name, port in (("dds", "127.0.0.1"), ("zenoh", "tcp/127.0.0.1:7447"))
    )


_OF_GO2: Final = "deal_hw.drivers.unitree.claim:WireClaim", "deal_hw.drivers.go2.doctor:Go2Doctor"
_OF_B2: Final = "deal_hw.drivers.b2.robot:B2Claim", "deal_hw.drivers.b2.doctor:B2Doctor"
_FEET: Final = ("left_foot", "right_foot")
_OF_H1: Final = "deal_hw.drivers.h1.robot:H1Claim", "deal_hw.drivers.h1.doctor:H1Doctor"
_OF_G1: Final = "deal_hw.drivers.g1.robot:G1Claim", "deal_hw.drivers.g1.doctor:G1Doctor"

CARTPOLE: Final = RobotEntry(
    name="cartpole",
    api_version=API_VERSION,
    driver="deal_hw.drivers.cartpole.robots.robot:CartpoleRobot",
    recorded="deal_hw.drivers.cartpole.description:DESCRIPTION",
    wires=(
        WireEntry(
            name="serial",
            transport="serial",
            emulator="deal_hw.drivers.cartpole.emulator.serial_emulator:serial_emulator",
        ),
        WireEntry(
            name="can",
            transport="can",
            driver="deal_hw.drivers.cartpole.robots.can_robot:can_robot",
            opens_port=True,
            emulator="deal_hw.drivers.cartpole.emulator.can_emulator:can_emulator",
            bus="deal_hw.drivers.cartpole.robots.can_robot:can_bus",
        ),
        WireEntry(
            name="odrive",
            transport="can",
            driver="deal_hw.drivers.cartpole.robots.odrive_robot:odrive_robot",
            opens_port=True,
            emulator="deal_hw.drivers.cartpole.emulator.odrive_emulator:odrive_emulator",
            bus="deal_hw.drivers.cartpole.robots.odrive_robot:odrive_bus",
        ),
        WireEntry(
            name="dynamixel",
            transport="serial",
            driver="deal_hw.drivers.cartpole.dynamixel.connect:dynamixel_robot",
            opens_port=True,
            emulator="deal_hw.drivers.cartpole.dynamixel.emulator:dynamixel_emulator",
            examine="deal_hw.drivers.cartpole.dynamixel.doctor:examine_servos",
        ),
    ),
    spaces="deal_hw.drivers.cartpole.description:SPACES",
    balance="deal_hw.motions.scores.balance:recorded_balance",
    other_wires="deal_hw.drivers.cartpole.wire.other_wires:name_other_wire",
    task="deal_hw.policies.tasks:CARTPOLE",
    environment="deal_hw/CartPole-v0",
    policy="deal_hw.policies:assets/cartpole_udr.onnx",
)
GO2: Final = RobotEntry(
    name="go2",
    api_version=API_VERSION,
    driver="deal_hw.drivers.go2.robot:Go2Robot",
    wires=_unitree_wires(*_OF_GO2),
    # On the floor it is simulated at other rates than its wire has.
    description="deal_hw.drivers.go2.descriptions.floor:DESCRIPTION",
    spaces="deal_hw.drivers.go2.descriptions.floor:SPACES",
    simulators={"unitree_mujoco": "deal_hw.drivers.go2.unitree_mujoco:UnitreeMujocoRobot"},
    odometry="deal_hw.drivers.go2.odometry:walked",
    sway="deal_hw.drivers.go2.motions:sway_plan",
    task="deal_hw.policies.tasks:GO2",
    environment="deal_hw/Go2-v0",
    policy="deal_hw.policies:assets/go2_walk.onnx",
    tasks={
        "canter": "deal_hw.policies.tasks:CANTER",
        "climb": "deal_hw.policies.tasks:CLIMB",
        "terrain": "deal_hw.policies.tasks:TERRAIN",
    },
    policies={
        "canter": "deal_hw.policies:assets/go2_canter.onnx",
        "canter_amp": "deal_hw.policies:assets/go2_canter_amp.onnx",
        "climb": "deal_hw.policies:assets/go2_climb.onnx",
        "climb_rma": "deal_hw.policies:assets/go2_climb_rma.onnx",
    },
    truth="deal_hw.drivers.go2.emulator.truth:Go2Truth",
    motors="deal_hw.drivers.go2.messages.wire:WIRE_JOINTS",
)
GO2_ON_STAND: Final = RobotEntry(
    name="go2_on_stand",
    api_version=API_VERSION,
    driver="deal_hw.drivers.go2.robot:Go2OnStandRobot",
    wires=_unitree_wires(*_OF_GO2, emulated=False),
    spaces="deal_hw.drivers.go2.descriptions.on_stand:SPACES",
    simulators={"unitree_mujoco": "deal_hw.drivers.go2.unitree_mujoco:UnitreeMujocoOnStandRobot"},
    machine="go2",
)
B2: Final = RobotEntry(
    name="b2",
    api_version=API_VERSION,
    driver="deal_hw.drivers.b2.robot:B2Robot",
    wires=_unitree_wires(*_OF_B2),
    recorded="deal_hw.drivers.b2.description:DESCRIPTION",
    spaces="deal_hw.drivers.b2.description:SPACES",
    odometry="deal_hw.drivers.b2.odometry:walked",
    sway="deal_hw.drivers.go2.motions:sway_plan",
    truth="deal_hw.drivers.b2.emulator:B2Truth",
    motors="deal_hw.drivers.go2.messages.wire:WIRE_JOINTS",
)
B2_ON_STAND: Final = RobotEntry(
    name="b2_on_stand",
    api_version=API_VERSION,
    driver="deal_hw.drivers.b2.robot:B2OnStandRobot",
    wires=_unitree_wires(*_OF_B2, emulated=False),
    recorded="deal_hw.drivers.b2.description:ON_STAND",
    spaces="deal_hw.drivers.b2.description:STAND_SPACES",
    machine="b2",
)
G1: Final = RobotEntry(
    name="g1",
    api_version=API_VERSION,
    driver="deal_hw.drivers.g1.robot:G1Robot",
    wires=_unitree_wires(*_OF_G1),
    recorded="deal_hw.drivers.g1.description:DESCRIPTION",
    spaces="deal_hw.drivers.g1.description:SPACES",
    truth="deal_hw.drivers.g1.emulator.truth:G1Truth",
    motors="deal_hw.drivers.g1.joints:JOINTS_29",
    feet=_FEET,
)
G1_23DOF: Final = RobotEntry(
    name="g1_23dof",
    api_version=API_VERSION,
    driver="deal_hw.drivers.g1.robot:G1Dof23Robot",
    wires=_unitree_wires(*_OF_G1),
    recorded="deal_hw.drivers.g1.description:DESCRIPTION_23",
    spaces="deal_hw.drivers.g1.description:SPACES_23",
    machine="g1",
    truth="deal_hw.drivers.g1.emulator.truth:G1Truth",
    motors="deal_hw.drivers.g1.joints:JOINTS_23",
    feet=_FEET,
)
H1: Final = RobotEntry(
    name="h1",
    api_version=API_VERSION,
    driver="deal_hw.drivers.h1.robot:H1Robot",
    wires=_unitree_wires(*_OF_H1),
    recorded="deal_hw.drivers.h1.description:DESCRIPTION",
    spaces="deal_hw.drivers.h1.description:SPACES",
    truth="deal_hw.drivers.h1.emulator:H1Truth",
    motors="deal_hw.drivers.h1.joints:MOTORS",
    feet=_FEET,
)
ALLEGRO: Final = RobotEntry(
    name="allegro",
    api_version=API_VERSION,
    description="deal_hw.robots.allegro.description:DESCRIPTION",
    spaces="deal_hw.robots.allegro.description:SPACES",
    task="deal_hw.policies.tasks:ALLEGRO",
    environment="deal_hw/Allegro-v0",
    policy="deal_hw.policies:assets/allegro_turn.onnx",
)
ANT: Final = RobotEntry(
    name="ant",
    api_version=API_VERSION,
    description="deal_hw.robots.ant.description:DESCRIPTION",
    spaces="deal_hw.robots.ant.description:SPACES",
    task="deal_hw.policies.tasks:ANT",
    environment="deal_hw/Ant-v0",
    policy="deal_hw.policies:assets/ant_udr.onnx",
)
GO2_SUSPENDED: Final = RobotEntry(
    name="go2_suspended",
    api_version=API_VERSION,
    description="deal_hw.drivers.go2.descriptions.on_stand_recording:DESCRIPTION",
    spaces="deal_hw.drivers.go2.descriptions.on_stand_recording:SPACES",
    machine="go2",
)
HUMANOID: Final = RobotEntry(
    name="humanoid",
    api_version=API_VERSION,
    description="deal_hw.robots.humanoid.description:DESCRIPTION",
    spaces="deal_hw.robots.humanoid.description:SPACES",
    task="deal_hw.policies.tasks:HUMANOID",
    environment="deal_hw/Humanoid-v0",
    policy="deal_hw.policies:assets/humanoid_walk.onnx",
)
SO101: Final = RobotEntry(
    name="so101",
    api_version=API_VERSION,
    wires=(
        WireEntry(
            name="serial",
            transport="serial",
            driver="deal_hw.drivers.so101.robot:so101_robot",
            opens_port=True,
            emulator="deal_hw.robots.file_emulator:emulate_so101",
        ),
    ),
    description="deal_hw.drivers.so101.description:DESCRIPTION",
    recorded="deal_hw.drivers.so101.description:DRIVEN",
    spaces="deal_hw.drivers.so101.description:SPACES",
    task="deal_hw.policies.tasks:SO101",
    environment="deal_hw/SO101-v0",
    policy="deal_hw.policies:assets/so101_udr.onnx",
)
ROBOTS: Final = (
    CARTPOLE,
    GO2,
    GO2_ON_STAND,
    B2,
    B2_ON_STAND,
    G1,
    G1_23DOF,
    H1,
    SO101,
    ALLEGRO,
    ANT,
    GO2_SUSPENDED,
    HUMANOID,
)
"""Those with a driver first: messages list them in this order."""
