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
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.control.process.realtime import die_with_parent
from deal_hw.errors import PolicyError
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.process_limits import limit


def main() -> int:
    """Answer until the other end is closed; return the exit code."""
    fd, parent, memory, seconds, file = sys.argv[1:]
    die_with_parent(int(parent))
    limit(int(memory), int(seconds))
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


if __name__ == "__main__":
    sys.exit(main())
