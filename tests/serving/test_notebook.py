"""The notebook of examples/ runs as it is, in a kernel of its own, and finds what is there."""

import re
from pathlib import Path

import nbclient
import nbformat

ROOT = Path(__file__).resolve().parents[2]


def test_detection_in_process() -> None:
    notebook = nbformat.read(ROOT / "examples" / "in_process.ipynb", as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(ROOT / "examples")}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.get("text", "") for output in outputs)
    (error,) = re.findall(r"off by (\d+) mm and (\d+) degrees", printed)
    assert int(error[0]) < 50, printed
    assert int(error[1]) < 25, printed
    assert "ImageError pixels are float64" in printed
    assert "CameraMissing model ape" in printed
    assert any("image/jpeg" in output.get("data", {}) for output in outputs)
