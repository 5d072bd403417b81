"""Runs a policy's network for :mod:`deal_hw.policies.trial`, in a process that may hang, crash or be killed.

It is started as ``python -m deal_hw.policies.trial_process FD PARENT MEMORY_BYTES SECONDS FILE``: one end of
a socket as inherited descriptor, the parent's process id, limits, and the policy. Messages are JSON. The
first describes the file. Then each list of observations is answered with actions and the processor time [s];
an empty list clears the network's memory.
Errors are answered as ``{"error": ...}``.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.control.process.realtime import die_with_parent
from deal_hw.errors import PolicyError
from deal_hw.policies.onnx_runtime import OnnxPolicy


def main() -> int:
    """Answer until the other end is closed; return the exit code."""
    fd, parent, memory, seconds, file = sys.argv[1:]
    die_with_parent(int(parent))
    _limit(int(memory), int(seconds))
    with Connection(int(fd)) as connection, contextlib.suppress(EOFError, ConnectionError):
        try:
            policy = OnnxPolicy(Path(file))
            _send(
                connection,
                {"spec": policy.spec.to_json(), "digest": policy.digest, "batches": policy.takes_batches},
            )
            while True:
                observations = np.array(json.loads(connection.recv_bytes()), dtype=np.float32)
                if not observations.size:
                    policy.reset()
                    _send(connection, {"actions": [], "seconds": 0.0})
                    continue
                begun = time.process_time()
                actions = policy.act_batch(observations)
                took = time.process_time() - begun
                _send(connection, {"actions": actions.tolist(), "seconds": took})
        except PolicyError as err:
            _send(connection, {"error": str(err)})
        except MemoryError:
            _send(connection, {"error": f"{file} needs more than {int(memory) // 2**20} MiB to load or run"})
    return 0


def _send(connection: Connection, message: dict[str, Any]) -> None:
    connection.send_bytes(json.dumps(message).encode())


def _limit(memory: int, seconds: int) -> None:
    """Limit memory and processor time of the network, beyond what Python and onnxruntime use already."""
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for kind, limit in (
        (resource.RLIMIT_AS, in_use + memory),
        # The kernel ends an endless network with SIGXCPU.
        (resource.RLIMIT_CPU, math.ceil(time.process_time()) + seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


if __name__ == "__main__":
    sys.exit(main())
