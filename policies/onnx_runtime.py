"""Runs a policy from its ONNX file; needs numpy and onnxruntime, neither torch nor mujoco."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from deal_hw.errors import PolicyError
from deal_hw.policy import Observation, PolicySpec
from deal_hw.types import FloatArray

SPEC_KEY = "deal_hw.policy_spec"
"""Key of the ONNX file's metadata under which the spec stands, as JSON."""


class OnnxPolicy:
    """A policy read from an ONNX file that carries its spec.

    One thread and no spinning: the control process shares its cores with nobody's surprise, and for a network
    of this size a second thread costs more than it computes.

    Args:
        path: The file.

    Raises:
        PolicyError: There is no such file, it is not ONNX, it carries no spec, or network and spec disagree.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._session = _open(self.path)
        text = self._session.get_modelmeta().custom_metadata_map.get(SPEC_KEY)
        if text is None:
            raise PolicyError(
                f"{self.path} is an ONNX file without a policy spec (metadata {SPEC_KEY!r}); "
                "export it with `deal-hw train`, or add one with deal_hw.policies.onnx_export.write_policy"
            )
        try:
            self._spec = PolicySpec.from_json(text)
        except PolicyError as err:
            raise PolicyError(f"{self.path}: {err}; train it again with this version of deal-hw") from err
        self._input, self._output = _check_shapes(self.path, self._session, self._spec)
        self._row = np.zeros((1, len(self._spec.observation)), dtype=np.float32)
        # The first run allocates; it must not happen inside the first control cycle.
        self._session.run([self._output], {self._input: self._row})

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        return self._spec

    def reset(self) -> None:
        """Nothing to forget: the observation carries the past."""

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,).

        Raises:
            PolicyError: The observation has another length.
        """
        if np.shape(observation) != (self._row.shape[1],):
            raise PolicyError(
                f"{self.path}: observation of shape {np.shape(observation)}, expected ({self._row.shape[1]},)"
            )
        self._row[0] = observation
        action: FloatArray = self.act_batch(self._row)[0]
        return action

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O)."""
        action: Any = self._session.run([self._output], {self._input: observations})[0]
        return np.asarray(action, dtype=np.float64)


def _open(path: Path) -> onnxruntime.InferenceSession:
    if not path.is_file():
        raise PolicyError(f"no such policy file: {path}; train one with `deal-hw train` or check the path")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    # onnxruntime's exceptions have no common base below Exception.
    except Exception as err:
        raise PolicyError(
            f"{path} is not an ONNX network that can be run ({str(err).splitlines()[0]}); "
            "give the .onnx file that `deal-hw train` wrote"
        ) from err


def _check_shapes(path: Path, session: onnxruntime.InferenceSession, spec: PolicySpec) -> tuple[str, str]:
    """Return the names of input and output after comparing their shapes with the spec."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or len(outputs) != 1:
        raise PolicyError(
            f"{path}: expected one input and one output, found {[i.name for i in inputs]} and "
            f"{[o.name for o in outputs]}"
        )
    wrong = [
        f"{what} {tensor.name!r} has shape {tensor.shape}, the spec says (batch, {length})"
        for what, tensor, length in (
            ("input", inputs[0], len(spec.observation)),
            ("output", outputs[0], len(spec.actuated)),
        )
        if len(tensor.shape) != 2 or tensor.shape[1] != length or tensor.type != "tensor(float)"
    ]
    if wrong:
        raise PolicyError(f"{path}: network and spec disagree: " + "; ".join(wrong))
    return str(inputs[0].name), str(outputs[0].name)
