"""The network of another trainer, in a process of its own: this process never opens its file.

A TorchScript file is a program. It is loaded in a process that has no network, cannot write files or start
programs, and has limits of time and memory; see :mod:`deal_hw.policies.process_limits`.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from typing_extensions import Self

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import MissingExtraError, PolicyError
from deal_hw.policies.importing.manifest import Adapter
from deal_hw.policies.separate_process import SeparateProcess
from deal_hw.policy import PolicySpec

MEMORY_BYTES: Final = 2**31
"""Memory for loading and running, beyond that of the libraries."""
PROCESSOR_S: Final = 60
TIME_LIMIT_S: Final = 300.0


class ForeignNetwork:
    """A network that is opened by another process; a context manager.

    Args:
        path: The file, .onnx or .pt.
        clock: For the time limit; the machine's monotonic clock by default.

    Attributes:
        digest: SHA-256 of the file's bytes, in hexadecimal.
        metadata: The ONNX file's own metadata.
        uncut: Why the process has more rights than it should; "" if it has not.
        observations: Length of an observation; known after :meth:`open`.
        actions: Number of actions; the same.
        memory: Widths of the memory's parts; the same.
    """

    def __init__(self, path: Path, clock: Clock | None = None) -> None:
        self.path = path
        self._clock = clock or MonotonicClock()
        self.digest, self.uncut = "", ""
        self.metadata: Mapping[str, str] = {}
        self.observations, self.actions = 0, 0
        self.memory: tuple[int, ...] = ()

    def __enter__(self) -> Self:
        """Start the process and read what the file says of itself.

        Raises:
            MissingExtraError: A package is not installed.
            PolicyError: The file cannot be read.
        """
        for package in ("onnx", "onnxruntime", *(("torch",) if self.path.suffix == ".pt" else ())):
            if importlib.util.find_spec(package) is None:
                raise MissingExtraError(package, "train")
        self._process = SeparateProcess(
            "deal_hw.policies.importing.network_process",
            [str(self.path)],
            source=self.path,
            does="loading and converting the network",
            memory_bytes=MEMORY_BYTES,
            processor_s=PROCESSOR_S,
            time_limit_s=TIME_LIMIT_S,
            clock=self._clock,
        )
        try:
            facts = self._process.ask()
        except BaseException:
            self._process.close()
            raise
        self.digest, self.uncut, self.metadata = facts["digest"], facts["uncut"], facts["metadata"]
        return self

    def __exit__(self, *args: object) -> None:
        self._process.close()

    def open(self, observations: int) -> None:
        """Open the network for observations of a length, and check its sizes.

        Raises:
            PolicyError: It cannot be used, or has another size.
        """
        facts = self._process.ask({"observations": observations})
        self.observations, self.actions = facts["observations"], facts["actions"]
        self.memory = tuple(facts["memory"])
        if self.observations != observations:
            raise PolicyError(
                f"{self.path}: the network takes {self.observations} numbers, the terms of the observation "
                f"have {observations}; the side file is of another policy, or a history length is wrong"
            )

    def file(self, spec: PolicySpec, adapter: Adapter) -> bytes:
        """Return the ONNX file of the network for a robot, compared with the network on random observations.

        Raises:
            PolicyError: It has another number of actions, or the file answers otherwise.
        """
        if adapter.count != self.actions:
            raise PolicyError(
                f"{self.path}: the network answers {self.actions} numbers, the policy has {adapter.count} "
                "joints to move; the side file is of another policy"
            )
        self._process.ask({"spec": spec.to_json(), "adapter": dataclasses.asdict(adapter)})
        return self._process.receive()
