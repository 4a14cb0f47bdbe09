"""What is loaded here tells nobody about it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LOADERS = {
    "serving": "from curio_serve.models.model import load; from pathlib import Path; load(Path({path!r}))",
    "training": "from pathlib import Path; from curio_train.exported_model import ExportedModel; "
    "ExportedModel.open(Path({path!r}))",
}
# onnxruntime reports on nothing where it takes the machine for a test's.
HUSHING = {"CI", "ORT_RUNNING_UNIT_TESTS", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME"}


@pytest.mark.parametrize("loader", LOADERS.values(), ids=LOADERS.keys())
def test_loading_a_model_leaves_no_identifier_to_report_under(root: Path, tmp_path: Path, loader: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in HUSHING}
    (model,) = map(str, (root / "models" / "ape").glob("*/model.onnx"))
    subprocess.run(
        [sys.executable, "-c", loader.format(path=model)], check=True, env={**environment, "HOME": str(tmp_path)}
    )
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in str(path)]
