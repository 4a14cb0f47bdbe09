"""The example of docs/api/detection.md runs as it is printed, and finds what is there."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PRINTED = re.compile(r"ape: confidence (0\.\d\d), at (-?\d\.\d{3}), (-?\d\.\d{3}), (\d\.\d{3}) m")


def test_detection_in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/api/detection.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    exec(compile(code, "docs/api/detection.md", "exec"), {})
    (found,) = PRINTED.findall(capsys.readouterr().out)
    poses = json.loads((ROOT / "samples" / "poses.json").read_text())["03.jpg"]
    (true,) = [pose["translation_m"] for pose in poses if pose["object"] == "ape"]
    assert [float(value) for value in found[1:]] == pytest.approx(true, abs=0.05)
