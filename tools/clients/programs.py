"""The programs that ``tools/check_clients.py`` runs: where they lie, what they need, what they must print."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

ODRIVE: Final = "ODriveResources/examples/"
SERVOS: Final = "DynamixelSDK/python/tests/protocol2_0/"
FEETECH: Final = "FTServo_Python/sms_sts/"
SO101: Final = ("{folder}/robot.yaml", "--profile", "ideal", "--nominal")
DYNAMIXEL: Final = ("cartpole", "--transport", "dynamixel", "--profile", "ideal")
NEXT: Final = "Press any key"
"""What ROBOTIS' examples print before they wait for a key."""
ESCAPE: Final = "\x1b"
NO_ERROR: Final = ("Traceback", "[TxRxResult]", "[RxPacketError]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Client:
    """A program of somebody else.

    Attributes:
        name: Its name in the table.
        source: File or folder below the user's folder that must be there; "" for a package of its own.
        command: Arguments after Python; ``{source}``, ``{port}``, ``{tools}``, ``{folder}``, its working
            folder, and ``{python}``, that of deal-hw, are replaced.
        emulator: Arguments of ``deal-hw emulate``; ``{folder}`` is replaced.
        plugin: Folder of this repository with a package that adds the robot, installed for the emulator.
        opens: The port or bus that the program opens by name; "" if it takes it as an argument.
        paths: Folders below the user's folder for PYTHONPATH.
        packages: Packages that it needs beside those of deal-hw.
        unused: Packages that it imports and does not use here: they are empty, whatever is installed.
        own_python: Whether the user must name its Python, because no environment can be made for it here.
        prepare: What the user does before: "velocity" sets an ODrive to velocity control, "factory" resets
            servos, except id and rate.
        files: Files in its working folder: "endpoints" and "config" of the emulated ODrive; "so101", an
            SO-101's robot.yaml and LeRobot's calibration of it; "homed", that of the emulated SO-101; "ros2",
            a robot.yaml of ros2_control with two joints.
        servo_rate: Baud rate of the servos.
        keys: Pairs: what is printed, and the keys to press then; each once, in this order.
        hesitation_s: Time before a key is pressed [s]: a program sets the terminal up after its prompt, and
            forgets earlier keys.
        must: Regular expressions that its output must contain.
        must_not: Texts that its output must not contain.
        stop_after_s: An endless program is stopped by Ctrl-C this long after its first output [s].
        limit_s: Longest run [s].
        exit_codes: Allowed exit codes.
    """

    name: str
    source: str
    command: tuple[str, ...]
    emulator: tuple[str, ...]
    plugin: str = ""
    opens: str = ""
    paths: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    own_python: bool = False
    prepare: Literal["", "velocity", "factory"] = ""
    files: tuple[Literal["endpoints", "config", "so101", "homed", "ros2"], ...] = ()
    servo_rate: int = 57_600
    keys: tuple[tuple[str, str], ...] = ()
    hesitation_s: float = 0.5
    must: tuple[str, ...] = ()
    must_not: tuple[str, ...] = NO_ERROR
    stop_after_s: float = 0.0
    limit_s: float = 90.0
    exit_codes: tuple[int, ...] = (0,)


def _odrive(name: str, *arguments: str, **more: object) -> Client:
    emulator = ("cartpole", "--transport", "odrive", "--node", "0", "--profile", "ideal", "--nominal")
    return Client(
        name=name,
        source=ODRIVE + name,
        command=("{source}", *arguments),
        emulator=emulator,
        opens="can0",
        **more,  # type: ignore[arg-type]
    )


def _servos(name: str, rate: int = 57_600, **more: object) -> Client:
    return Client(
        name=name,
        source=SERVOS + name,
        command=("{source}",),
        emulator=(*DYNAMIXEL, "--servo-baud-rate", str(rate)),
        servo_rate=rate,
        opens="/dev/ttyUSB0",
        paths=("DynamixelSDK/python/src",),
        prepare="factory",
        **more,  # type: ignore[arg-type]
    )


def _feetech(name: str, **more: object) -> Client:
    return Client(
        name=f"sms_sts/{name}",
        source=FEETECH + name,
        command=("{source}",),
        emulator=SO101,
        opens="/dev/ttyUSB0",
        paths=("FTServo_Python",),
        files=("so101",),
        **more,  # type: ignore[arg-type]
    )


BUS: Final = ("-c", "can0")
MOVE: Final = ((NEXT, " "), (NEXT, " "), (NEXT, ESCAPE))
REACHED: Final = (r"\[ID:001\] GoalPos:0+ +PresPos", r"\[ID:001\] GoalPos:4095")

CLIENTS: Final = (
    _odrive(
        "can_simple.py",
        prepare="velocity",
        stop_after_s=6.0,
        must=(r"pos: [\d.-]+ \[turns\], vel: 0\.[5-9]", r"vel: -0\.[5-9]"),
        must_not=(),
        exit_codes=(130, 1, -2),
    ),
    _odrive(
        "can_enumerate.py", *BUS, must=(r"Discovered ODrive \w{12} \(node ID 0\)", "Discovered 1 ODrives")
    ),
    _odrive(
        "can_enumerate.py",
        *BUS,
        "--save-config",
        "motor=5",
        keys=(("Enter a number", "0\n"),),
        must=(
            "Which one is flashing",
            "Assigning new node IDs to 1 ODrives",
            "Saving configuration on 1 ODrives",
        ),
    ),
    _odrive(
        "can_param_access.py",
        files=("endpoints",),
        must=(r"received: 1\.2339\d+", r"received: \[0\.0\]"),
    ),
    _odrive(
        "can_restore_config.py",
        *BUS,
        "--node-id",
        "0",
        "--endpoints-json",
        "flat_endpoints.json",
        "--config",
        "config.json",
        "--save-config",
        files=("endpoints", "config"),
        must=("checking version", "writing 4 variables", "saving configuration"),
    ),
    _odrive("can_calibrate.py", *BUS, "--node-id", "0", must=("Calibration successful!",)),
    _servos("ping.py", must=(r"ping Succeeded. Dynamixel model number : 1190",)),
    _servos("broadcast_ping.py", must=(r"\[ID:001\] model version : 1190", r"\[ID:002\]")),
    _servos("read_write.py", keys=MOVE, must=REACHED),
    _servos("sync_read_write.py", keys=MOVE, must=REACHED),
    _servos("bulk_read_write.py", keys=MOVE, must=(r"\[ID:001\] Present Position", r"LED Value")),
    _servos("fast_sync_read.py", 1_000_000, keys=MOVE, must=REACHED),
    _servos("fast_bulk_read.py", 1_000_000, keys=MOVE, must=(r"Present Position: \d+", r"LED Value: 1")),
    _servos("indirect_address.py", keys=MOVE, must=(r"GoalPos:0 .* IsMoving:1", r"GoalPos:4095 ")),
    _servos("reboot.py", keys=((NEXT, " "),), must=("reboot Succeeded",)),
    _servos(
        "factory_reset.py",
        must=("factoryReset Success!", "DXL baudnum is now : 1", "Dynamixel Baudnum is now : 1"),
    ),
    _servos(
        "clear_multi_turn.py",
        keys=((NEXT, " "), ("GoalPos:1048575", " "), (NEXT, ESCAPE)),
        must=("Operating mode changed", r"Present Position has been reset. : \d{3,4}\b"),
    ),
    Client(
        name="DynamixelMotorsBus",
        source="lerobot/src/lerobot/motors",
        command=("{tools}/half_turn_homing.py", "{port}"),
        emulator=DYNAMIXEL,
        paths=("lerobot/src",),
        packages=("deepdiff", "tqdm", "draccus", "accelerate", "datasets"),
        must=(
            r"range_min=0, range_max=4095",
            r"position after half-turn homing: 2047",
            r"position after a move to 2400: 2(3[89]|4[01])\d",
        ),
    ),
    Client(
        name="FeetechMotorsBus",
        source="lerobot/src/lerobot/motors",
        command=("{tools}/so_arm.py", "{port}", "{folder}/so101.json"),
        emulator=SO101,
        paths=("lerobot/src",),
        packages=("deepdiff", "tqdm", "draccus", "accelerate", "datasets", "feetech-servo-sdk"),
        files=("so101",),
        must=(
            r"calibrated: True P gains: \{'shoulder_pan': 16, .*'gripper': 16\}",
            r"off by at most [0-3]\.",
            "connected: False",
        ),
    ),
    Client(
        name="physical-cartpole",
        source="physical-cartpole/Driver/DriverFunctions",
        command=("{tools}/bench_cartpole.py", "{port}"),
        emulator=("bench_cartpole", "--profile", "ideal"),
        plugin="examples/thirdparty",
        paths=("physical-cartpole/Driver/DriverFunctions",),
        unused=("pandas",),
        must=(
            "ping answered: True",
            "calibrated: True",
            r"motor commands \[1500\]",
            r"moved by \d{3} counts",
        ),
    ),
    Client(
        name="zenoh-ros2-sdk",
        source="",
        command=("{tools}/ros2_sdk.py", "{port}", "{folder}/robot.yaml", "{python}"),
        emulator=("{folder}/robot.yaml", "--transport", "zenoh", "--port", "tcp/127.0.0.1:7461"),
        packages=("zenoh-ros2-sdk==0.1.8",),
        files=("ros2",),
        must=(r"states in 1 s, joints \w+", r"off by at most 0\.0\d", "refused: True"),
    ),
    Client(
        name="SO101Follower",
        source="lerobot/src/lerobot/robots",
        command=("{tools}/so_follower.py", "{port}", "{folder}"),
        emulator=("so101", "--profile", "ideal", "--nominal"),
        paths=("lerobot/src",),
        # torchvision's wheels expect a torch with CUDA.
        unused=("torchvision",),
        packages=(
            "deepdiff",
            "tqdm",
            "draccus",
            "accelerate",
            "datasets",
            "av",
            "einops",
            "opencv-python-headless",
            "feetech-servo-sdk",
        ),
        files=("homed",),
        must=("calibrated: True", r"off by at most [0-7]\.", "connected: False"),
    ),
    _feetech("ping.py", must=(r"\[ID:001\] ping Succeeded. SCServo model number : 777",)),
    _feetech(
        "read.py",
        must=(r"\[ID:001\] PresPos:20[45]\d PresSpd:0",),
        stop_after_s=3.0,
        exit_codes=(130, 1, -2),
        must_not=("[TxRxResult]", "[RxPacketError]"),
    ),
    _feetech(
        "sync_read.py",
        must=(r"\[ID:001\] PresPos:\d+ PresSpd:0", r"\[ID:006\] PresPos:\d+ PresSpd:0"),
        stop_after_s=3.0,
        exit_codes=(130, 1, -2),
        must_not=("[RxPacketError]",),
    ),
    Client(
        name="go2_stand_example.py",
        source="unitree_sdk2_python/example/go2/low_level/go2_stand_example.py",
        command=("{source}", "{port}"),
        emulator=("go2", "--transport", "dds", "--port", "lo"),
        paths=("unitree_sdk2_python",),
        own_python=True,
        keys=(("Press Enter", "\n"),),
        must=("Done!",),
        # The example ends with sys.exit(-1).
        exit_codes=(255,),
    ),
    Client(
        name="g1_low_level_example.py",
        source="unitree_sdk2_python/example/g1/low_level/g1_low_level_example.py",
        command=("{source}", "{port}"),
        emulator=("g1", "--transport", "dds", "--port", "lo", "--profile", "ideal", "--nominal"),
        paths=("unitree_sdk2_python",),
        own_python=True,
        keys=(("Press Enter", "\n"),),
        # Roll, pitch and yaw of every 500th state: its types and ours match, and the states' checksum is no
        # matter to it. That its commands are taken is in the emulator's report.
        must=(r"\[-?0\.\d+, -?0\.\d+, -?0\.\d+\]",),
        # The three stages, 9 s: all joints to 0, ankles as pitch and roll, ankles as parallel motors.
        stop_after_s=12.0,
        exit_codes=(130, 1, -2),
        must_not=(),
    ),
    Client(
        name="h1_low_level_example.py",
        source="unitree_sdk2_python/example/h1/low_level/h1_low_level_example.py",
        command=("{source}", "{port}"),
        emulator=("h1", "--transport", "dds", "--port", "lo", "--profile", "ideal", "--nominal"),
        paths=("unitree_sdk2_python",),
        own_python=True,
        keys=(("Press Enter", "\n"),),
        # It waits for its own controller's release, and takes all joints to 0 within 10 s.
        must=(r"rpy: \[ -?\d", "Done!"),
        # The example ends with sys.exit(-1).
        exit_codes=(255,),
    ),
)
