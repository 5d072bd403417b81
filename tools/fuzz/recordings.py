"""Episodes, the dataset's index, run.json and planned excitations."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import zstandard

from deal_hw.clock import VirtualClock
from deal_hw.data.files import INDEX_NAME
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.episode_info import summarize
from deal_hw.data.recording.mcap_scan import FoundRecord, messages, scan
from deal_hw.data.recording.reader import read_episode, read_wire
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.recording.repair import repair, verify
from deal_hw.data.run_folder import RunFolder
from deal_hw.description import digest_of
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError
from deal_hw.motions.excitation.plan import ExcitationDesign, make_plan, read_plan
from deal_hw.transport import Message
from deal_hw.types import BodyState, Event, JointCommand, RobotState, Status
from fuzz.kind import FileKind, Kind
from fuzz.mutations import damage_bytes, damage_json, flip, mended, overwrite

_CYCLE_NS = 20_000_000
_EPISODE = "000001.mcap"


def make_cycle(number: int, body: bool = False) -> CycleRecord:
    """Return a cycle of a cart-pole; ``body`` adds the sensors of a robot with legs."""
    start_ns = 7_000_000_000_000 + number * _CYCLE_NS

    def values(size: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.sin(0.1 * number + np.arange(size, dtype=np.float64))

    sensed = BodyState(
        orientation=values(4),
        angular_velocity=values(3),
        acceleration=values(3),
        sticks=values(4),
        foot_force=values(4),
        temperature=values(2),
        lost=np.zeros(2, dtype=np.int64),
        battery=0.9,
        voltage=28.0,
        current=1.0,
        buttons=0,
    )
    state = RobotState(
        values(2),
        values(2),
        values(2),
        start_ns,
        start_ns - 1_000_000,
        number,
        number - 1,
        1_000_000,
        Status.ARMED,
        sensed if body else None,
    )
    command = JointCommand(*(values(1) for _ in range(7)))
    return CycleRecord(
        number,
        start_ns,
        start_ns,
        (state,),
        values(1),
        command,
        command,
        number,
        start_ns,
        1000,
        "ACTIVE",
        events=(Event(start_ns, "note", "words", {"joint": "cart"}),) if number % 4 == 0 else (),
        wire=(Message("rx", bytes([number]) * 30, start_ns), Message("tx", b"\1\2", start_ns)),
    )


def make_episode(path: Path, cycles: int, body: bool = False, torn: bool = False) -> bytes:
    """Record some cycles and return the file."""
    clock = VirtualClock(7_000_000_000_000)
    wall_ns = 1_760_000_000_000_000_000
    recorder = EpisodeRecorder(
        path, DESCRIPTION.to_json(), {"purpose": "fuzz"}, clock, wall_ns=lambda: wall_ns
    )
    recorder.open()
    for number in range(cycles):
        clock.sleep_until_ns(7_000_000_000_000 + (number + 1) * _CYCLE_NS)
        recorder.write(make_cycle(number, body))
    whole = path.read_bytes()
    recorder.close()
    return whole if torn else path.read_bytes()


def make_episodes(folder: Path) -> list[bytes]:
    """Return small whole and torn episodes."""
    choices = itertools.product((12, 30), (False, True), (False, True))
    return [make_episode(folder / f"{i}.mcap", *choice) for i, choice in enumerate(choices)]


@cache
def _known_samples() -> frozenset[tuple[int, bytes]]:
    """Return every message in the episodes above, over all channels."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return frozenset(
            (message.log_time, message.data)
            for data in make_episodes(Path(folder))
            for item in scan(data)
            if isinstance(item, FoundRecord)
            for message in messages(item)
        )


def read_damaged(path: Path) -> None:
    """Read, verify, repair, read; every sample read must have been recorded."""
    with contextlib.suppress(DatasetError):
        read_episode(path)
    _one_line(verify(path).describe())
    _one_line(repair(path).describe())
    found = {
        (message.log_time, message.data)
        for item in scan(path.read_bytes())
        if isinstance(item, FoundRecord)
        for message in messages(item)
    }
    if invented := found - _known_samples():
        raise AssertionError(f"{len(invented)} samples are not those that were recorded")
    summarize(path, "episodes/000001.mcap")
    for _ in read_wire(path):
        pass


def read_hostile(path: Path) -> None:
    """Verify, repair, read; any content is allowed."""
    _one_line(verify(path).describe())
    _one_line(repair(path).describe())
    summarize(path, "episodes/000001.mcap")
    for _ in read_wire(path):
        pass


def read_stray(path: Path) -> None:
    """Open a dataset for a collector that finds this episode in its folder."""
    folder = path.parent.parent
    with Dataset.create_or_open(folder, DESCRIPTION, _one_line):
        pass
    if (size := (folder / INDEX_NAME).stat().st_size) > 100_000:
        raise AssertionError(f"the index has {size} bytes")
    Dataset.open(folder, _one_line)


def _one_line(text: str) -> None:
    if len(text.splitlines()) != 1 or len(text) > 1000:
        raise AssertionError(f"{len(text)} characters in {len(text.splitlines())} lines: {text[:300]}")


def forge(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Change the content of chunks and metadata, and correct checksums and lengths: a malicious file."""
    out = bytearray(data[:8])
    at, struck = 8, rng.randrange(8)
    while at + 9 <= len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        body = data[at + 9 : at + 9 + size]
        if len(body) < size:
            break
        if opcode == 6 and (struck := struck - 1) < 0 and rng.random() < 0.5:
            body = _forged_chunk(rng, body, others)
        elif opcode in (1, 12) and rng.random() < 0.2:
            body = damage_bytes(rng, body, others)[: 1 << 14]
        out += struct.pack("<BQ", opcode, len(body)) + body
        at += 9 + size
    return bytes(out) + data[-8:]


def _forged_chunk(rng: random.Random, body: bytes, others: Sequence[bytes]) -> bytes:
    start, stop, _, _ = struct.unpack_from("<QQQI", body)
    inner = bytearray(zstandard.decompress(body[44:]))
    way = rng.randrange(4)
    if way == 0:
        inner = bytearray(damage_bytes(rng, bytes(inner), [bytes(inner)]))
    elif way == 1:
        for _ in range(rng.choice((1, 3, 10))):
            rng.choice((flip, overwrite))(rng, inner, others)
    elif way == 2:
        inner *= rng.choice((2, 1000))
    else:
        inner = bytearray(rng.choice((1 << 10, 1 << 20, 1 << 25)))
    packed = zstandard.compress(bytes(inner))
    size = rng.choice((len(inner), len(inner), 0, 1 << 62))
    head = struct.pack("<QQQI", start, stop, size, zlib.crc32(inner))
    return head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed


def make_indexes(folder: Path) -> list[bytes]:
    """Return the index of an empty dataset and of one with two episodes."""
    found = []
    for count in (0, 2):
        path = folder / str(count)
        with Dataset.create_or_open(path, DESCRIPTION, _one_line) as dataset:
            for _ in range(count):
                episode = dataset.next_episode_path()
                make_episode(episode, 30)
                dataset.note_episode(episode, {"outcome": "finished"})
        found.append((path / INDEX_NAME).read_bytes())
    return found


def _mend_digest(data: bytes) -> bytes:
    """Return an index whose digest fits its description, if it can be computed."""
    with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
        values = json.loads(data)
        values["digest"] = digest_of(values["description"])
        return json.dumps(values).encode()
    return data


def read_index(path: Path) -> None:
    """Open a dataset for reading and for collecting, and describe it as `deal-hw data info` does."""
    from deal_hw.cli.data import InfoSettings, data

    with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="utf-8")):
        data(InfoSettings(path=path.parent, json=True))
        data(InfoSettings(path=path.parent))
    with Dataset.create_or_open(path.parent, DESCRIPTION, _one_line):
        pass


def make_run(folder: Path) -> list[bytes]:
    """Return the run.json of a run."""
    run = RunFolder(folder / "run")
    with run:
        run.start({"robot": "cartpole", "seeds": [1, 2]}, {"emulator": 3}, argv=["deal-hw", "demo"])
    return [(run.path / "run.json").read_bytes()]


def read_run(path: Path) -> None:
    """Read a run's record and write it again, as a continued run does."""
    json.dumps(RunFolder(path.parent).read(), ensure_ascii=False).encode()


def make_plans(folder: Path) -> list[bytes]:
    """Return a plan of each family."""
    found = []
    for family in ("multisine", "chirp", "steps"):
        path = folder / f"{family}.json"
        design = ExcitationDesign(family=family, effort=(0.5, 1.0))
        make_plan(DESCRIPTION, design).write(path)
        found.append(path.read_bytes())
    return found


def play_plan(path: Path) -> None:
    """Read a plan as the control process does, and play it."""
    plan = read_plan(path)
    plan.check_fits(DESCRIPTION)
    offsets = plan.offsets(np.linspace(0.0, 5.0, 50))
    if offsets.shape != (50, len(DESCRIPTION.actuated)) or not np.isfinite(offsets).all():
        raise AssertionError(f"the plan gives offsets of shape {offsets.shape}, some of them not finite")


def _files(
    name: str, make: Callable[[Path], Sequence[bytes]], read: Callable[[Path], object], *ways: object
) -> FileKind:
    return FileKind(name=name, make=make, read=read, mutations=ways)  # type: ignore[arg-type]


KINDS: dict[str, Kind] = {
    "mcap": _files(_EPISODE, make_episodes, read_damaged, damage_bytes),
    "mcap_hostile": _files(_EPISODE, make_episodes, read_hostile, forge),
    "mcap_stray": _files(f"episodes/{_EPISODE}", make_episodes, read_stray, damage_bytes, forge),
    "dataset_json": _files(
        INDEX_NAME, make_indexes, read_index, damage_bytes, damage_json, mended(damage_json, _mend_digest)
    ),
    "run_json": _files("run.json", make_run, read_run, damage_bytes, damage_json, damage_json),
    "excitation_json": _files("plan.json", make_plans, play_plan, damage_bytes, damage_json, damage_json),
}
