"""Writes a torch network as an ONNX file with its policy spec inside and its training record beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx

from deal_hw.errors import PolicyError
from deal_hw.policies.onnx_runtime import SPEC_KEY, OnnxPolicy
from deal_hw.policy import PolicySpec

if TYPE_CHECKING:
    import torch

TOLERANCE = 1e-5
"""Largest difference between network and file on an action in [-1, 1]."""
ROUNDING = 1e-6
"""Rounding of a sum in single precision, as share of the sum of its absolute terms."""


def export_network(
    network: torch.nn.Module, spec: PolicySpec, path: Path, record: Mapping[str, Any] | None = None
) -> OnnxPolicy:
    """Write a network, compare the file with it, and return the file's policy.

    Files are written under other names and then renamed, so that an interrupted export leaves nothing that
    could be deployed.

    Args:
        network: Observations (B, O) in, actions (B, A) out: a Sequential of linear layers and activations,
            or a FeedbackNetwork of one.
        spec: Its spec.
        path: The .onnx file; the record goes beside it with the suffix .json.
        record: Plain JSON values about the training.

    Raises:
        PolicyError: A layer has an unknown type, or the file computes other actions than the network.
    """
    # Not above: who only writes a spec into a network of another trainer needs no torch.
    from deal_hw.policies.onnx_graph import network_graph

    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.draft")
    try:
        write_policy(network_graph(network, len(spec.observation)), spec, draft)
        policy = OnnxPolicy(draft)
        _check_equal(network, policy)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    if record is not None:
        path.with_suffix(".json").write_text(
            json.dumps(dict(record), indent=2, sort_keys=True) + "\n", encoding="utf-8"
        )
    return OnnxPolicy(path)


def write_policy(model: onnx.ModelProto, spec: PolicySpec, path: Path) -> None:
    """Write an ONNX network with a policy spec inside, weights included, as one file."""
    kept = {entry.key: entry.value for entry in model.metadata_props if entry.key != SPEC_KEY}
    onnx.helper.set_model_props(model, {**kept, SPEC_KEY: spec.to_json()})
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def _check_equal(network: torch.nn.Module, policy: OnnxPolicy) -> None:
    from deal_hw.policies.onnx_graph import actions, largest_sum

    # Fixed draws: an export must not use the caller's random generators.
    scales = np.array([0.1, 1.0, 10.0], dtype=np.float32)[:, None, None]
    draws = np.random.default_rng(0).standard_normal((3, 32, len(policy.spec.observation))).astype(np.float32)
    observations = (scales * draws).reshape(-1, draws.shape[-1])
    worst = float(np.abs(policy.act_batch(observations) - actions(network, observations)).max())
    allowed = max(TOLERANCE, ROUNDING * largest_sum(network, observations))
    if not worst <= allowed:
        raise PolicyError(
            f"the exported policy differs from the network by {worst:g}, allowed are {allowed:g}; "
            "replace the operation that ONNX computes differently"
        )
