"""The firmware in Python and its C core: recorded outputs, and one equal to the other, bit by bit."""

import hashlib
import json
import os
import random
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from firmware_inputs import IntegerServo, outputs
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware, Mode
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.chips.firmwares import FIRMWARES, usable_firmware
from deal_hw.drivers.cartpole.chips.host_firmware import HostFirmware, Settings, library, settings_of
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import (
    DAMPING_NS_M,
    EFFORT_LIMIT_N,
    SPEED_LIMIT_M_S,
    STIFFNESS_N_M,
    parameter_space,
)
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, candidate_truth, nominal_truth
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.protocol import Target
from deal_hw.errors import ConfigurationError

needs_compiler = pytest.mark.skipif(
    shutil.which(native.compiler()) is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "protocol-cartpole-serial.md"
I32 = st.integers(-(2**31), 2**31 - 1)
U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
NOMINAL = {p.name: p.nominal for p in parameter_space().parameters}


@pytest.mark.parametrize(
    ("seed", "recorded"),
    [(0, "e4b52a0a03a95585"), (1, "ddf512606437f997"), (2, "28e61e054e37046d")],
)
def test_outputs_are_the_recorded_ones(seed: int, recorded: str) -> None:
    """Bytes, forces and modes of 3000 ticks of commands, garbage and watchdog stops are as recorded."""
    delays = random.Random(seed)
    firmware = Controller(Servo(NOMINAL, 0.001), 7, lambda: delays.randint(5, 8))
    digest = hashlib.sha256()
    armed = 0
    for out, force, mode in outputs(firmware, seed):
        digest.update(out + struct.pack("<d", force) + mode.encode())
        armed += mode == "ARMED"
    assert armed > 200
    assert digest.hexdigest()[:16] == recorded


def pair(truth: CartpoleTruth, seed: int, delays: tuple[int, int]) -> tuple[Controller, HostFirmware]:
    """Return both firmwares, whose commands are late by the same draws."""
    first, second = random.Random(seed), random.Random(seed)
    trims = settings_of(truth, 0)
    return (
        Controller(IntegerServo(trims), trims.unique_id, lambda: first.randint(*delays)),
        HostFirmware(trims, lambda: second.randint(*delays)),
    )


@needs_compiler
@pytest.mark.parametrize("seed", range(6))
def test_recorded_inputs_give_the_same_outputs(seed: int) -> None:
    """3000 ticks of commands, garbage and watchdog stops; hidden trims, commands late by 0 to 28 ticks."""
    truth = candidate_truth("realistic", np.random.default_rng(seed), seed=seed, range_ratio=5.0, refused=0)
    python, core = pair(truth, seed, (0, 0) if seed == 0 else (seed, 28))
    modes = []
    for ours, theirs in zip(outputs(python, seed), outputs(core, seed), strict=True):
        assert theirs == ours
        modes.append(ours[2])
    assert {"IDLE", "HOMING", "ARMED"} == set(modes)
    assert (core.frame_errors, core.watchdog) == (python.frame_errors, python.watchdog)


MOTORS = st.builds(lambda p, v: Motor(p / 2**28, v / 2**18), I32, I32)
READINGS = st.builds(Reading, I32, I32, I32, I32, I32.map(lambda nm: nm / 2**30), st.booleans())
MESSAGES = st.one_of(
    st.builds(lambda *v: protocol.encode(Target(*v)), st.integers(0, 3) | U32, I32, U32, U32, U16, U32),
    st.builds(
        lambda *v: protocol.encode(Target(*v)),
        st.integers(0, 2**32 - 2),
        st.integers(-400_000, 400_000),
        st.integers(0, 200_000),
        st.integers(0, 20_000),
        st.integers(0, 8000),
        st.integers(0, 3_000_000),
    ),
    st.builds(
        lambda kind, request: protocol.encode(kind(request)),
        st.sampled_from([protocol.Arm, protocol.Arm, protocol.Home, protocol.Stop]),
        st.integers(0, 3),
    ),
    st.builds(lambda *v: protocol.encode(protocol.Hello(*v)), st.integers(0, 255), st.integers(0, 255)),
    st.binary(max_size=70),
    st.binary(max_size=70).map(lambda data: data + b"\0"),
)
TICKS = st.lists(st.tuples(st.lists(MESSAGES, max_size=3), MOTORS, READINGS, st.sampled_from((1, 3, 210))))


@needs_compiler
@settings(deadline=None, max_examples=300)
@given(TICKS, st.tuples(*[st.integers(0, 2**32 - 1) | st.just(65536)] * 4), st.booleans())
def test_any_inputs_give_the_same_outputs(
    ticks: list[tuple[list[bytes], Motor, Reading, int]], trims: tuple[int, int, int, int], homed: bool
) -> None:
    """Any bytes, positions, gains and trims of any size, armed from the start or not."""
    sent = Settings(*trims, 7, 0)
    both: list[Firmware] = [Controller(IntegerServo(sent), 7, lambda: 2), HostFirmware(sent, lambda: 2)]
    found: list[list[object]] = [[], []]
    for firmware, seen in zip(both, found, strict=True):
        if homed:
            firmware.receive(protocol.encode(protocol.Home(254)), Motor(0.0, 0.0))
            firmware.finish_homing()
            firmware.receive(protocol.encode(protocol.Arm(255)), Motor(0.0, 0.0))
        for messages, motor, reading, repeat in ticks:
            seen.append(firmware.receive(b"".join(messages), motor))
            for _ in range(repeat):
                force, due = firmware.control(motor)
                seen += [force, firmware.report(reading) if due else b"", firmware.mode, firmware.setpoint]
        seen += [firmware.watchdog, firmware.homings, firmware.armings]
    assert found[1] == found[0]


@needs_compiler
def test_test_vectors_of_the_protocol_page() -> None:
    """What a device sends is, byte for byte, what the page has; what it takes, it takes from there."""
    rows = re.findall(r"^\| `(\w+)\((.+?)\)` \| `([0-9a-f ]+)` \|", PAGE.read_text(), re.MULTILINE)
    frames = [bytes.fromhex(text) for _, _, text in rows]
    assert [name for name, _, _ in rows] == [
        "Hello",
        "Info",
        "Arm",
        "Stop",
        "Home",
        "Ack",
        "Target",
        "Target",
        "State",
        "State",
    ]
    hello, info, arm, stop, home, refused, *targets, first_state, _ = frames
    still = Motor(0.0, 0.0)
    core = HostFirmware(settings_of(nominal_truth(seed=3), 0), lambda: 0)
    assert core.receive(hello, still) == info
    assert core.receive(arm, still) == refused
    assert core.control(still) == (0.0, True)
    assert core.report(Reading(0, 0, 3141593, 0, 0.0)) == first_state
    core.receive(home + stop, still)
    assert core.mode is Mode.IDLE
    core.receive(protocol.encode(protocol.Home(77)), still)
    core.finish_homing()
    core.receive(protocol.encode(protocol.Arm(9)), still)
    core.receive(targets[0], still)
    # -12.345 mm lie beyond 1 m/s times 1 ms: 80 N/m times -1 mm.
    assert core.control(still)[0] == pytest.approx(-0.08, abs=1e-12)
    core.receive(targets[1], still)
    assert core.control(still)[0] == 0.0
    assert core.frame_errors == 0


@needs_compiler
def test_a_full_queue_keeps_the_newest_target() -> None:
    """300 targets that all wait for 10 ticks: 256 have room, the last one is what acts in the end."""
    core = HostFirmware(Settings(65536, 65536, 65536, 65536, 1, 0), lambda: 10)
    still = Motor(0.0, 0.0)
    core.receive(protocol.encode(protocol.Home(1)), still)
    core.finish_homing()
    core.receive(protocol.encode(protocol.Arm(2)), still)
    for number in range(300):
        core.receive(protocol.encode(Target(number, number, 80_000, 8_000, 4_000, 2**31)), still)
    for _ in range(11):
        core.control(still)
    assert core.setpoint == pytest.approx(299e-6)


@needs_compiler
@pytest.mark.parametrize("profile", ["ideal", "realistic"])
def test_the_core_moves_the_same_robot_as_the_float_servo(profile: str) -> None:
    """One second of random targets with a falling pole: at most 10 um and 1 mrad apart."""
    truth = candidate_truth(profile, np.random.default_rng(5), seed=5, range_ratio=5.0, refused=0)
    devices = [
        CartpoleDevice(truth, keep_truth=True),
        CartpoleDevice(truth, keep_truth=True, firmware=HostFirmware.of),
    ]
    paths = []
    for device in devices:
        rng = np.random.default_rng(0)
        device.receive(protocol.encode(protocol.Home(1)))
        device.advance_to(510_000_000)
        device.receive(protocol.encode(protocol.Arm(2)))
        for number in range(50):
            target = int(rng.integers(-200_000, 200_000))
            device.receive(protocol.encode(Target(number, target, 80_000, 8_000, 4_000, 1_000_000)))
            device.advance_to(device.device_ns + 20_000_000)
        assert device.armed
        paths.append(device.true_trajectory())
    apart = np.abs(paths[0].position - paths[1].position).max(axis=0)
    assert np.all(apart < (10e-6, 1e-3))
    assert np.abs(paths[0].position[:, 0]).max() > 0.02


@needs_compiler
def test_a_host_without_compiler_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name of the compiler, and the way around it."""
    monkeypatch.setenv("CC", "no-such-cc")
    with pytest.raises(ConfigurationError, match="no-such-cc, which is not installed; apt-get install gcc"):
        native.build("x", (native.compiler(),), (), "apt-get install gcc")


@pytest.mark.parametrize(("target", "chip"), [("firmware", "avr"), ("firmware-arm", "stm32")])
def test_an_image_needs_no_environment(target: str, chip: str, tmp_path: Path) -> None:
    """The target installs no package, and its program runs on a Python without any; fake compilers."""
    if shutil.which("make") is None:
        pytest.skip("no make")
    printed = subprocess.run(
        # As on a machine that never ran `make setup`.
        ["make", "--no-print-directory", "-n", "-W", "pyproject.toml", f"VENV={tmp_path / 'venv'}", target],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "pip" not in printed and str(tmp_path) not in printed
    _fake_tools(tmp_path)
    environment = {"PYTHONPATH": ".", "PATH": f"{tmp_path}:/usr/bin:/bin", "XDG_CACHE_HOME": str(tmp_path)}
    arguments = printed.strip().splitlines()[-1].partition("drivers/")[2].split()[:-1]
    command = [sys.executable, "-S", f"drivers/{arguments[0]}", *arguments[1:], str(tmp_path / "out")]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "") and arguments[1] == chip
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {
        ".elf",
        ".hex" if chip == "avr" else ".bin",
    }
    for tool in tmp_path.glob("a*-gcc"):
        tool.unlink()
    environment |= {"PATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "empty")}
    refused = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert refused.returncode == 1 and refused.stderr.startswith("make firmware: the firmware needs a")


def _fake_tools(folder: Path) -> None:
    """Write compilers that make an empty file: of ``-o FILE``, and of objcopy's last argument."""
    for prefix in ("avr", "arm-none-eabi"):
        for tool, line in (
            ("gcc", 'while [ "$1" != -o ]; do shift; done; : > "$2"'),
            ("objcopy", 'for last; do :; done; : > "$last"'),
            ("size", "echo; echo 1 2 3"),
        ):
            path = folder / f"{prefix}-{tool}"
            path.write_text(f"#!/bin/sh\n{line}\n")
            path.chmod(0o755)


@needs_compiler
def test_the_emulator_runs_the_core_where_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """auto: the C core; without a compiler the firmware in Python. A firmware that was named stays."""
    library.cache_clear()
    assert usable_firmware("auto") == "host"
    library.cache_clear()
    monkeypatch.setenv("CC", "no-such-compiler")
    assert [usable_firmware(name) for name in FIRMWARES] == ["python", "host", "python", "avr"]
    library.cache_clear()


@needs_compiler
def test_sources_that_do_not_compile_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler's own words come along, and nothing is left in the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ConfigurationError, match="does not compile"):
        native.build("x.so", (native.compiler(), "-no-such-option"), native.CORE, "")
    assert not list(tmp_path.rglob("x.so"))


@needs_compiler
def test_float_servo_and_core_agree_on_nominal_gains() -> None:
    """80 N/m times 20 mm less 8 N s/m times 0.1 m/s is 0.8 N in both."""
    servo = Servo(NOMINAL, 0.001)
    integer = IntegerServo(settings_of(nominal_truth(), 0))
    for one in (servo, integer):
        one.accept(Target(0, 20_000, 80_000, 8_000, 4_000, 2**31))
        assert one.update(0.0, 0.1) == pytest.approx(0.8, abs=1e-9)
    assert EFFORT_LIMIT_N == 4.0
    assert (STIFFNESS_N_M, DAMPING_NS_M, SPEED_LIMIT_M_S) == (80.0, 8.0, 1.0)


@needs_compiler
@pytest.mark.parametrize("wire", ["serial", "can"])
def test_a_fuzz_run_finds_nothing(wire: str) -> None:
    """200 000 whole, mutated and random frames: no crash, no frame lost, no corrupt one taken."""
    done = subprocess.run(
        [native.fuzzer(wire), "200000", "1"], capture_output=True, text=True, check=True, timeout=120
    )
    found = json.loads(done.stdout)
    assert found["good"] + found["corrupt"] + found["garbage"] > 199_000
    # A random frame passes a CRC of 16 bits once in 65 536; these are 160 000, most of them no frame at all.
    assert found["accepted"] + found["garbage_accepted"] <= 8
    assert found["armed"] > 10_000
