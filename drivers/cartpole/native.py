"""Builds the firmware's C sources on demand, into the user's cache."""

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

SOURCES = Path(__file__).parent / "firmware"
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
CFLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")
SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def cache() -> Path:
    """Return the folder of what was built: ``$XDG_CACHE_HOME/deal-hw/firmware``."""
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
    for path in sorted(SOURCES.rglob("*.[ch]")):
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


def write_image(folder: Path) -> str:
    """Write ``cartpole.elf`` and ``cartpole.hex`` into a folder; return what avr-size says of them.

    Raises:
        ConfigurationError: There is no avr-gcc, or it refuses the sources.
    """
    folder.mkdir(parents=True, exist_ok=True)
    elf, code = folder / "cartpole.elf", folder / "cartpole.hex"
    shutil.copy(image(), elf)
    subprocess.run(["avr-objcopy", "-O", "ihex", "-R", ".eeprom", str(elf), str(code)], check=True)
    size = ["avr-size", "-C", "--mcu=atmega328p", str(elf)]
    return subprocess.run(size, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    print(write_image(Path(sys.argv[1])))
