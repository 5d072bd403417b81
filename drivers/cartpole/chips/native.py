"""Builds the firmware's C sources on demand, into the user's cache.

Also a program of its own, for `make firmware`: it imports nothing but the standard library and the errors, so
any Python 3.10 or newer runs it without an environment.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from deal_hw.errors import ConfigurationError

SOURCES = Path(__file__).parents[1] / "firmware"
SERIAL_CORE = ("frames.c", "servo.c", "cartpole.c")
CORE = (*SERIAL_CORE, "can_frames.c")
RIG = ("avr/main.c", "rig.c", *SERIAL_CORE)
AVR_CC = (
    "avr-gcc",
    "-std=gnu99",
    "-mmcu=atmega328p",
    "-DF_CPU=16000000UL",
    "-Os",
    "-flto",
    "-Wall",
    "-Wextra",
    "-Werror",
)
STM32 = {
    "cartpole-stm32": "stm32/main.c",
    "pole-encoder-stm32": "stm32/encoder.c",
}
"""Programs for the STM32F103C8: the cart-pole, and the pole encoder node beside a motor drive."""
QEMU_CORE = ("stm32/startup.c", "host/qemu.c", "host/core.c", *CORE)
ARM_CC = (
    "arm-none-eabi-gcc",
    "-std=gnu99",
    "-mcpu=cortex-m3",
    "-mthumb",
    "-Os",
    "-flto",
    "-ffreestanding",
    "-nostdlib",
    "-Wall",
    "-Wextra",
    "-Werror",
)
ARM_INSTALL = "apt-get install --no-install-recommends gcc-arm-none-eabi"
CFLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def cache() -> Path:
    """Return the folder of built files: ``$XDG_CACHE_HOME/deal-hw/firmware``."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "deal-hw" / "firmware"


def build(
    name: str, command: Sequence[str], sources: Sequence[str], install: str, libraries: Sequence[str] = ()
) -> Path:
    """Compile sources into one file, unless the cache has it from the same sources and command.

    Args:
        name: Name of the file.
        command: The compiler and its options.
        sources: Sources to compile, below the firmware's folder.
        install: How to get the compiler and its libraries on Debian.
        libraries: Options after the sources.

    Raises:
        ConfigurationError: There is no such compiler, or it refuses the sources.
    """
    if shutil.which(command[0]) is None:
        raise ConfigurationError(f"the firmware needs {command[0]}, which is not installed; {install}")
    digest = hashlib.sha256("\0".join((*command, *sources, *libraries)).encode())
    for path in sorted(SOURCES.rglob("*.[chl]*")):
        digest.update(path.read_bytes())
    target = cache() / digest.hexdigest()[:16] / name
    if target.is_file():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    # Built beside and moved: another process may build or load the same file now.
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        out = Path(folder) / name
        arguments = [*command, "-o", str(out), *(str(SOURCES / file) for file in sources), *libraries]
        done = subprocess.run(arguments, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ConfigurationError(f"the firmware does not compile; {install}\n{done.stderr.strip()}")
        out.rename(target)
    return target


def compiler() -> str:
    """Return the C compiler of this host: ``$CC``, or cc."""
    return os.environ.get("CC") or "cc"


def fuzzer(wire: str = "serial") -> Path:
    """Return the core's fuzzer for "serial" or "can" (arguments: inputs, seed), built with the sanitizers.

    Raises:
        ConfigurationError: There is no C compiler, or it refuses the sources.
    """
    name = {"serial": "fuzz", "can": "fuzz_can"}[wire]
    command = (compiler(), *CFLAGS, *SANITIZERS)
    return build(name, command, (f"host/{name}.c", *CORE), "apt-get install gcc libc6-dev")


def image() -> Path:
    """Return the firmware of the ATmega328P as an ELF file.

    Raises:
        ConfigurationError: There is no avr-gcc, or it refuses the sources.
    """
    return build("cartpole.elf", AVR_CC, RIG, "apt-get install gcc-avr avr-libc")


def stm32_image(program: str = "cartpole-stm32", *, qemu: bool = False) -> Path:
    """Return a firmware of the STM32F103 as an ELF file.

    Args:
        program: A name in :data:`STM32`.
        qemu: Do not wait for the clocks, which QEMU does not have.

    Raises:
        ConfigurationError: There is no arm-none-eabi-gcc, or it refuses the sources.
    """
    sources = ("stm32/startup.c", "stm32/board.c", STM32[program], "rig.c", *CORE)
    return arm_build(f"{program}.elf", sources, *(("-DQEMU",) if qemu else ()))


def arm_build(name: str, sources: Sequence[str], *options: str) -> Path:
    """Return C sources compiled and linked for a Cortex-M3, as an ELF file of that name.

    Raises:
        ConfigurationError: There is no arm-none-eabi-gcc, or it refuses the sources.
    """
    script = ("-T", str(SOURCES / "stm32" / "link.ld"))
    return build(name, (*ARM_CC, *options), sources, ARM_INSTALL, (*script, "-lgcc"))


def write_image(folder: Path) -> str:
    """Write ``cartpole.elf`` and ``cartpole.hex`` into a folder; return the report of avr-size.

    Raises:
        ConfigurationError: There is no avr-gcc, or it refuses the sources.
    """
    folder.mkdir(parents=True, exist_ok=True)
    elf, code = folder / "cartpole.elf", folder / "cartpole.hex"
    shutil.copy(image(), elf)
    subprocess.run(["avr-objcopy", "-O", "ihex", "-R", ".eeprom", str(elf), str(code)], check=True)
    size = ["avr-size", "-C", "--mcu=atmega328p", str(elf)]
    return subprocess.run(size, check=True, capture_output=True, text=True).stdout


def write_stm32_image(folder: Path) -> str:
    """Write ``.elf`` and ``.bin`` of each of :data:`STM32` into a folder; return the memory of each as text.

    Raises:
        ConfigurationError: There is no arm-none-eabi-gcc, or it refuses the sources.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for program in STM32:
        elf, code = folder / f"{program}.elf", folder / f"{program}.bin"
        shutil.copy(stm32_image(program), elf)
        subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", str(elf), str(code)], check=True)
        size = ["arm-none-eabi-size", str(elf)]
        sizes = subprocess.run(size, check=True, capture_output=True, text=True).stdout
        code_bytes, data, zero = (int(text) for text in sizes.splitlines()[1].split()[:3])
        lines.append(
            f"{code.name} for the STM32F103C8: flash {code_bytes + data} bytes of 65536, "
            f"RAM {data + zero} bytes of 20480 (the stack has the rest of the first 8192)"
        )
    return "\n".join(lines)


def main(chip: str, folder: str) -> int:
    """Write a chip's images into a folder and print their memory use; return the exit code.

    Args:
        chip: "avr" or "stm32".
        folder: The folder.
    """
    try:
        print({"avr": write_image, "stm32": write_stm32_image}[chip](Path(folder)))
    except ConfigurationError as error:
        print(f"make firmware: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
