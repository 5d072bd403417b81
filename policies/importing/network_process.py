"""Opens a network of another trainer, in a process without network, robot and rights; see ``network.py``.

It is started as ``python -m deal_hw.policies.importing.network_process FD PARENT MEMORY_BYTES SECONDS FILE``.
Messages are JSON, but for the bytes of a finished file. TorchScript runs here only: nothing of it reaches
another process, except the ONNX that was built operation by operation.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from deal_hw.control.process.realtime import die_with_parent
from deal_hw.errors import PolicyError
from deal_hw.policies.importing.manifest import Adapter
from deal_hw.policies.importing.onnx_network import Network, Runner, adapted, read_network
from deal_hw.policies.onnx_runtime import read_policy_file
from deal_hw.policies.process_limits import cut_off, limit
from deal_hw.policy import Observation
from deal_hw.schema import from_values

TOLERANCE: Final = 1e-5
"""Largest difference between the network and the file made of it, as share of the largest action, or of 1."""
DRAWS: Final = 64
STEPS: Final = 8
"""Observations in a row for a network with a memory."""
MOST_METADATA: Final = 1_000_000

Run = Callable[[Observation], npt.NDArray[Any]]


def main() -> int:
    """Answer until the other end is closed; return the exit code."""
    fd, parent, memory, seconds, file = sys.argv[1:]
    die_with_parent(int(parent))
    path = Path(file)
    script = path.suffix == ".pt"
    if script:
        # Before the limits, which count what the libraries take.
        import torch  # noqa: F401

        from deal_hw.policies.importing import torchscript  # noqa: F401
    limit(int(memory), int(seconds))
    whole = cut_off()
    with Connection(int(fd)) as connection, contextlib.suppress(EOFError, ConnectionError):
        try:
            content = read_policy_file(path)
            opened = _Script(content) if script else _Onnx(path, content)
            digest = hashlib.sha256(content).hexdigest()
            _send(connection, {"digest": digest, "metadata": opened.metadata, "uncut": whole})
            _send(connection, opened.open(int(json.loads(connection.recv_bytes())["observations"])))
            while True:
                _answer(connection, path, opened, json.loads(connection.recv_bytes()))
        except PolicyError as err:
            text = str(err) if str(path) in str(err) else f"{path}: {err}"
            _send(connection, {"error": text})
        except MemoryError:
            _send(connection, {"error": f"{path} needs more than {int(memory) // 2**20} MiB to load or run"})
    return 0


class _Onnx:
    """An ONNX file."""

    def __init__(self, path: Path, content: bytes) -> None:
        beside = path.with_name(path.name + ".data")
        outside = read_policy_file(beside) if beside.exists() else None
        self._path = path
        self.network = read_network(path, content, outside)
        props = self.network.model.metadata_props
        self.metadata = {entry.key: entry.value for entry in props}
        if sum(len(key) + len(value) for key, value in self.metadata.items()) > MOST_METADATA:
            raise PolicyError(f"{path} has more than {MOST_METADATA // 1000} kB of metadata")

    def open(self, observations: int) -> dict[str, Any]:
        runner = Runner(self._path, self.network.model.SerializeToString())
        self.run, self.reset = runner, runner.reset
        return _facts(self.network)


class _Script:
    """A TorchScript file."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.metadata: dict[str, str] = {}

    def open(self, observations: int) -> dict[str, Any]:
        from deal_hw.policies.importing.torchscript import convert

        found = convert(self._content, observations)
        layers = [0] * len(found.memory)
        self.network = Network(found.model, found.observations, found.actions, found.memory, layers)
        self.run, self.reset = found.run, found.reset
        return _facts(self.network)


def _facts(network: Network) -> dict[str, Any]:
    return {"observations": network.observations, "actions": network.actions, "memory": network.memory}


def _answer(connection: Connection, path: Path, opened: _Onnx | _Script, request: dict[str, Any]) -> None:
    """Write the file that is asked for, compare it with the network, and send it."""
    adapter = from_values(Adapter, request["adapter"])
    network = opened.network
    worst: list[float] = []
    for batches in (True, False):
        try:
            content = adapted(network, adapter, request["spec"], batches=batches)
            worst = [_difference(opened.run, opened.reset, Runner(path, content), network, adapter, batches)]
        except PolicyError:
            if not batches:
                raise
        # onnx and onnxruntime raise nearly anything for a graph whose sizes are fixed inside.
        except Exception as err:
            if not batches:
                raise PolicyError(f"{path}: the network cannot be adapted ({str(err)[:200]})") from err
        if worst and worst[0] <= TOLERANCE:
            break
    if not worst or not worst[0] <= TOLERANCE:
        raise PolicyError(
            f"{path}: the file that was made answers otherwise than the network, by "
            f"{worst[0] if worst else 0:g} of the largest action; allowed are {TOLERANCE:g}; export the "
            "policy as ONNX by another way"
        )
    _send(connection, {"bytes": len(content), "batches": batches, "worst": worst[0]})
    connection.send_bytes(content)


def _difference(
    run: Run, reset: Callable[[], None], made: Runner, network: Network, adapter: Adapter, batches: bool
) -> float:
    """Return the largest difference of actions, as share of the largest action or of 1."""
    rng = np.random.default_rng(0)
    low, high = (np.array(ends, dtype=np.float32) for ends in (adapter.lowest, adapter.highest))
    order = np.array(adapter.outputs)
    shape = (DRAWS, STEPS if network.memory else 1, network.observations)
    spread = np.array([0.1, 1.0, 3.0, 10.0], dtype=np.float32)[np.arange(DRAWS) % 4]
    draws = spread[:, None, None] * rng.standard_normal(shape).astype(np.float32)
    wanted = np.zeros((DRAWS, shape[1], len(order)))
    for i, sequence in enumerate(draws):
        reset()
        for k, observation in enumerate(sequence):
            clipped = np.minimum(np.maximum(observation, low), high)
            wanted[i, k] = np.where(order < 0, 0.0, run(clipped[None])[0][np.maximum(order, 0)])
    if batches:
        made.reset()
        found = np.stack([made(draws[:, k]) for k in range(shape[1])], axis=1)
    else:
        found = np.empty_like(wanted)
        for i, sequence in enumerate(draws):
            made.reset()
            for k, observation in enumerate(sequence):
                found[i, k] = made(observation[None])[0]
    if not (np.isfinite(wanted).all() and np.isfinite(found).all()):
        raise PolicyError("the network answers with numbers that are not finite; train it again")
    return float(np.abs(found - wanted).max() / max(1.0, float(np.abs(wanted).max())))


def _send(connection: Connection, message: dict[str, Any]) -> None:
    connection.send_bytes(json.dumps(message).encode())


if __name__ == "__main__":
    sys.exit(main())
