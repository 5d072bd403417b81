"""The picture of the demo's end, from what its run folder holds."""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from draw_demo_end import main

from deal_hw.calibration import CalibrationResult
from deal_hw.drivers.cartpole.description import k9_space


def test_the_picture_says_what_the_terminal_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sentence, a row a parameter, both commands; nothing of it is loaded from another host."""
    space = k9_space()
    interval = np.stack([0.9 * space.nominal, 1.1 * space.nominal], axis=1)
    result = CalibrationResult(method="default", space=space, estimate=space.nominal, interval=interval)
    run = tmp_path / "run"
    (run / "calibration").mkdir(parents=True)
    (run / "calibration" / "result.json").write_text(json.dumps(result.to_json()), encoding="utf-8")
    parameters = {
        p.name: {
            "unit": p.unit,
            "nominal": p.nominal,
            "estimate": p.nominal,
            "low": 0.9 * p.nominal,
            "high": 1.1 * p.nominal,
            "truth": p.nominal,
        }
        for p in space
    }
    summary = {
        "sentence": "The policy held the pole up.",
        "parameters": parameters,
        "known": {"pole.length": {"value": 0.3, "truth": 0.3}},
        "latency_s": {"found": 0.02, "true": 0.018},
        "paths": {"episode": "runs/demo/dataset/episodes/000000.mcap"},
    }
    (run / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    picture = tmp_path / "end.svg"
    monkeypatch.setattr(sys, "argv", ["draw_demo_end.py", str(run), "--out", str(picture)])
    main()
    text = picture.read_text(encoding="utf-8")
    reported = "".join(ElementTree.fromstring(text).itertext()).replace("\xa0", " ")
    for words in (
        "The policy held the pole up.",
        *space.names,
        "not fitted",
        "18 (outside)",
        "deal-hw inspect",
    ):
        assert words in reported
    assert set(re.findall(r"https?://[^\s\"<)]+", re.sub(r"<!--.*?-->", "", text))) <= {
        "http://www.w3.org/2000/svg"
    }
