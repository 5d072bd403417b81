"""Checks a policy's file with ONNX's own checker and runs it with onnxruntime."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime


def main(path: Path) -> None:
    """Check shapes and types throughout, and run it once."""
    onnx.checker.check_model(onnx.load(path), full_check=True)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (given,) = session.get_inputs()
    shape = [size if isinstance(size, int) else 1 for size in given.shape]
    (action, *_) = session.run(None, {given.name: np.zeros(shape, dtype=np.float32)})
    if not np.all(np.isfinite(action)):
        raise AssertionError(f"action {action}")
    print(f"checked; {given.name} {shape} gives {list(np.shape(action))}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
