"""Runs a policy from its ONNX file; needs numpy and onnxruntime, neither torch nor mujoco."""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.errors import MissingExtraError, PolicyError
from deal_hw.policy import Observation, PolicySpec
from deal_hw.types import FloatArray

try:
    import onnxruntime
except ImportError as err:
    raise MissingExtraError("onnxruntime", "deploy") from err

SPEC_KEY = "deal_hw.policy_spec"
"""Key of the spec, as JSON, in the ONNX file's metadata."""
MAX_FILE_BYTES: Final = 100_000_000
"""Largest policy file: some 25 million weights, a hundred times what a policy at 50 Hz has."""
MAX_MEMORY: Final = 65_536
"""Most numbers of one part of a recurrent network's memory."""
_NO_FOLDER: Final = os.devnull + "/weights-outside-of-the-file"


class OnnxPolicy:
    """A policy from an ONNX file that contains its spec.

    A recurrent network also has inputs and outputs for its memory, (B, n) each. What comes out goes in with
    the next observation, and is zero after a reset.

    It uses one thread without spinning: a second thread costs more than it gains for networks of this size,
    and would disturb the control process.

    Args:
        path: The file. It is read once, and the network is made from these bytes.
        digest: Required :attr:`digest`; "" for any file.

    Attributes:
        path: The file.
        digest: SHA-256 of its bytes, in hexadecimal.

    Raises:
        PolicyError: The file is missing, too large or not ONNX, has another digest or no spec, or network and
            spec disagree.
    """

    def __init__(self, path: Path | str, digest: str = "") -> None:
        self.path = Path(path)
        content = read_policy_file(self.path)
        self.digest = hashlib.sha256(content).hexdigest()
        if digest not in ("", self.digest):
            raise PolicyError(
                f"{self.path} was changed after it was checked: its SHA-256 begins {self.digest[:16]}, "
                f"the checked file's {digest[:16]}; start again"
            )
        self._session = open_session(self.path, content)
        try:
            self._spec = _read_spec(self.path, self._session)
            self._input, self._output = _check_shapes(self.path, self._session, self._spec)
            self._kept = _check_memory(self.path, self._session, self._spec)
        except UnicodeDecodeError as err:
            raise PolicyError(
                f"{self.path} is damaged: a name inside is no UTF-8 text; copy or export the file again"
            ) from err
        self._row = np.zeros((1, len(self._spec.observation)), dtype=np.float32)
        # The first run allocates memory; it must not happen in the first control cycle.
        self._memory: list[Observation] = []
        self.act_batch(self._row)
        self.reset()

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        return self._spec

    @property
    def takes_batches(self) -> bool:
        """Whether the network takes more than one observation at a time."""
        return bool(self._session.get_inputs()[0].shape[0] != 1)

    def reset(self) -> None:
        """Clear the memory of a recurrent network; of others past values are part of the observation."""
        self._memory = []

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,).

        Raises:
            PolicyError: The observation has another length, or the network fails on it.
        """
        if np.shape(observation) != (self._row.shape[1],):
            raise PolicyError(
                f"{self.path}: observation of shape {np.shape(observation)}, expected ({self._row.shape[1]},)"
            )
        self._row[0] = observation
        action: FloatArray = self.act_batch(self._row)[0]
        return action

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O).

        A recurrent network begins anew with another B.

        Raises:
            PolicyError: The network fails on them, or answers with another shape.
        """
        count = len(observations)
        if self._kept and (not self._memory or len(self._memory[0]) != count):
            self._memory = [np.zeros((count, kept.width), dtype=np.float32) for kept in self._kept]
        values = {kept.input: value for kept, value in zip(self._kept, self._memory, strict=True)}
        outputs = [self._output, *(kept.output for kept in self._kept)]
        try:
            action, *memory = self._session.run(outputs, {self._input: observations, **values})
        # onnxruntime's exceptions have no common base below Exception.
        except Exception as err:
            raise PolicyError(
                f"{self.path}: the network fails on an observation of the right shape ({_first_line(err)}); "
                "give another policy"
            ) from err
        wanted = (count, len(self._spec.actuated))
        if [np.shape(value) for value in memory] != [np.shape(value) for value in self._memory]:
            raise PolicyError(f"{self.path}: the network's memory changes its shape; give another policy")
        self._memory = memory
        if np.shape(action) != wanted:
            raise PolicyError(
                f"{self.path}: output {self._output!r} came with shape {np.shape(action)}, the spec says "
                f"{wanted}; give another policy"
            )
        return np.asarray(action, dtype=np.float64)


def read_policy_file(path: Path) -> bytes:
    """Return the bytes of a policy file.

    Raises:
        PolicyError: The file is missing, not regular, or larger than :data:`MAX_FILE_BYTES`.
    """
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise PolicyError(
                    f"{path} is not a regular file; give the .onnx file that `deal-hw train` wrote"
                )
            content = file.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError as err:
        raise PolicyError(
            f"no such policy file: {path}; train one with `deal-hw train` or check the path"
        ) from err
    except (OSError, ValueError) as err:
        why = err.strerror if isinstance(err, OSError) else err
        raise PolicyError(f"the policy file {path} cannot be read ({why}); check path and rights") from err
    if len(content) > MAX_FILE_BYTES:
        raise PolicyError(
            f"{path} is larger than {MAX_FILE_BYTES // 1_000_000} MB, the largest policy that is taken; "
            "give the .onnx file that `deal-hw train` wrote"
        )
    return content


def _open_at_once(path: str, flags: int) -> int:
    # Opening a FIFO would otherwise wait for a writer.
    return os.open(path, flags | os.O_NONBLOCK)


def open_session(path: Path, content: bytes) -> onnxruntime.InferenceSession:
    """Return what runs the network of a file's bytes, with one thread and no other file.

    Raises:
        PolicyError: It is no ONNX, or cannot be run.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # A network may name other files with its weights. They are not part of the digest, so none is read:
    # onnxruntime looks for them where no file can be.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", _NO_FOLDER)
    # Fatal errors only: the error below reports the others once.
    options.log_severity_level = 4
    try:
        # Its fallback prints, and repeats the same on the same processor.
        return onnxruntime.InferenceSession(
            content, options, providers=["CPUExecutionProvider"], enable_fallback=0
        )
    # onnxruntime's exceptions have no common base below Exception.
    except Exception as err:
        if "xternal" in str(err):
            raise PolicyError(
                f"{path} keeps its weights in another file; export the network as one file "
                f"({_first_line(err)})"
            ) from err
        raise PolicyError(
            f"{path} is not an ONNX network that can be run ({_first_line(err)}); "
            "give the .onnx file that `deal-hw train` wrote"
        ) from err


def _read_spec(path: Path, session: onnxruntime.InferenceSession) -> PolicySpec:
    text = session.get_modelmeta().custom_metadata_map.get(SPEC_KEY)
    if text is None:
        raise PolicyError(
            f"{path} is an ONNX file without a policy spec (metadata {SPEC_KEY!r}); "
            "export it with `deal-hw train`, or add one with deal_hw.policies.onnx_export.write_policy"
        )
    try:
        return PolicySpec.from_json(text)
    except PolicyError as err:
        raise PolicyError(f"{path}: {err}; train it again with this version of deal-hw") from err


def _first_line(err: Exception) -> str:
    lines = str(err).splitlines() or [type(err).__name__]
    return lines[0] if len(lines[0]) <= 200 else lines[0][:197] + "..."


def _check_shapes(path: Path, session: onnxruntime.InferenceSession, spec: PolicySpec) -> tuple[str, str]:
    """Return the names of input and output after comparing their shapes with the spec."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if spec.recurrent:
        inputs, outputs = inputs[:1], outputs[:1]
    if len(inputs) != 1 or len(outputs) != 1:
        raise PolicyError(
            f"{path}: expected one input and one output, found {[i.name for i in inputs]} and "
            f"{[o.name for o in outputs]}"
        )
    wrong = [
        f"{what} {tensor.name!r} is {tensor.type} of shape {tensor.shape}, the spec says tensor(float) of "
        f"shape (batch, {length})"
        for what, tensor, length in (
            ("input", inputs[0], len(spec.observation)),
            ("output", outputs[0], len(spec.actuated)),
        )
        if len(tensor.shape) != 2
        or tensor.shape[1] != length
        or tensor.type != "tensor(float)"
        or (isinstance(tensor.shape[0], int) and tensor.shape[0] != 1)
    ]
    if wrong:
        raise PolicyError(f"{path}: network and spec disagree: " + "; ".join(wrong))
    return str(inputs[0].name), str(outputs[0].name)


@dataclass(frozen=True, slots=True)
class _Kept:
    """A part of a network's memory, (B, width): its input and its output."""

    input: str
    output: str
    width: int


def _check_memory(path: Path, session: onnxruntime.InferenceSession, spec: PolicySpec) -> list[_Kept]:
    """Return the memory's inputs and outputs, which come in pairs behind observation and action."""
    if not spec.recurrent:
        return []
    inputs, outputs = session.get_inputs()[1:], session.get_outputs()[1:]
    shapes = [[(tensor.type, *tensor.shape[1:]) for tensor in side] for side in (inputs, outputs)]
    if not inputs or shapes[0] != shapes[1] or not all(_is_row(tensor) for tensor in (*inputs, *outputs)):
        raise PolicyError(
            f"{path}: the memory of a recurrent network has an output (batch, n) for each input, as "
            f"tensor(float); found {[(t.name, t.shape) for t in inputs]} and "
            f"{[(t.name, t.shape) for t in outputs]}"
        )
    pairs = zip(inputs, outputs, strict=True)
    return [_Kept(str(i.name), str(o.name), int(i.shape[1])) for i, o in pairs]


def _is_row(tensor: Any) -> bool:
    sizes = tensor.shape
    return (
        tensor.type == "tensor(float)"
        and len(sizes) == 2
        and isinstance(sizes[1], int)
        and 0 < sizes[1] <= MAX_MEMORY
    )
