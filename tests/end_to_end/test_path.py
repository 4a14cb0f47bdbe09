"""From images without labels to poses over gRPC, through the commands a user types.

Then serving and detection where nothing that the base install leaves out can be imported: in one file with the others,
so that one process of the tests trains the run that both look at.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_serve.client import PoseClient
from curio_train.commands.evaluate import evaluate
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.scene_code import TRANSLATION
from curio_train.worlds import build

TOLERANCE = 1e-5  # image widths
ROOT = Path(__file__).parents[2]
BLOCKED = (
    "torch",
    "mitsuba",
    "drjit",
    "onnx",
    "onnxscript",
    "trimesh",
    "scipy",
    "skimage",
    "matplotlib",
    "PIL",
    "curio_train",
)
REFUSING = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED}:
            raise ImportError(name + " is blocked in this test")

sys.meta_path.insert(0, Blocked())
"""


@pytest.fixture(scope="module")
def expected(run: Path, images: torch.Tensor) -> np.ndarray:
    """What the trained network says of the frames, [num_frames, 3]."""
    folder = RunFolder.open(run)
    network = folder.trained(build(folder.config.world)).pose.network
    with torch.no_grad():
        found = network(images.float() / 255)[TRANSLATION][:, 0].numpy()
    assert np.ptp(found, axis=0)[:2].min() > 20 * TOLERANCE, "one answer to everything: the tests would show nothing"
    return found


def test_grpc_says_what_the_network_says(
    models: Path, frames: list[Path], expected: np.ndarray, serving: Callable[..., object]
) -> None:
    with serving(models) as address, PoseClient(address) as client:
        assert [(m.name, list(m.versions), list(m.objects)) for m in client.list_models()] == [
            ("circles", [1], ["circle"])
        ]
        answers = [client.detect("circles", frame) for frame in frames]
    found = [answer.results[0].detections[0].translation_m for answer in answers]
    assert np.array(found) == pytest.approx(expected, abs=TOLERANCE)


def test_the_server_tells_the_specification(models: Path, serving: Callable[..., object]) -> None:
    with serving(models) as address, PoseClient(address) as client:
        answer = client.get_model("circles")
    assert (answer.version, answer.spec.world, answer.spec.images_seen) == (1, "circles", 640)
    assert 0 <= answer.spec.parity_max_abs_error <= 1e-4


def test_detection_of_a_folder_says_the_same(
    models: Path, frames: list[Path], expected: np.ndarray, call: Callable[..., object], tmp_path: Path
) -> None:
    out = tmp_path / "found.jsonl"
    call("curio-detect", models / "circles", frames[0].parent, "--out", out, "--overlays", tmp_path / "overlays")
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [Path(row["image"]).name for row in rows] == [frame.name for frame in frames]
    assert {(row["model"]["name"], row["model"]["version"]) for row in rows} == {("circles", 1)}
    found = np.array([row["detections"][0]["translation_m"] for row in rows])
    assert found == pytest.approx(expected, abs=TOLERANCE)
    for frame in frames:
        drawn = cv2.imread(str(tmp_path / "overlays" / frame.name))
        assert drawn is not None
        assert (drawn != cv2.imread(str(frame))).any()


def test_detection_through_the_server_says_the_same(
    models: Path, frames: list[Path], expected: np.ndarray, call: Callable[..., object], serving: Callable[..., object]
) -> None:
    with serving(models) as address:
        done = call("curio-detect", f"{address}/circles", *frames)
    found = [json.loads(line)["detections"][0]["translation_m"] for line in done.stdout.splitlines()]
    assert np.array(found) == pytest.approx(expected, abs=TOLERANCE)


def test_run_and_model_get_the_same_marks(
    run: Path, models: Path, call: Callable[..., object], capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--num-images", "60", "--cache", str(run.parent / "cache"), "--json"]
    of_run = json.loads(call("curio-eval", run, *flags).stdout.splitlines()[-1])
    with pytest.raises(SystemExit) as exit_:  # the second time in this process, which spares the imports
        evaluate([str(models / "circles"), *flags])
    assert not exit_.value.code
    of_model = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert of_run["num_images"] == of_model["num_images"] == 60
    for name, value in of_run["metrics"].items():
        assert of_model["metrics"][name] == pytest.approx(value, rel=1e-4), name
    assert of_model["untrained"] == of_run["untrained"]
    assert of_run["untrained"] != of_run["metrics"]
    kept = json.loads((run / "evaluation.json").read_text())
    assert kept == of_run


@pytest.fixture(scope="module")
def blocked(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Environment variables under which every Python process refuses these packages."""
    folder = tmp_path_factory.mktemp("hook")
    (folder / "sitecustomize.py").write_text(REFUSING)
    return {"PYTHONPATH": str(folder)}


@pytest.mark.parametrize("package", BLOCKED)
def test_the_block_holds(blocked: Mapping[str, str], package: str) -> None:
    command = [sys.executable, "-c", f"import {package}"]
    done = subprocess.run(command, env=os.environ | blocked, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "is blocked in this test" in done.stderr


def test_detection_works(
    models: Path,
    frames: list[Path],
    blocked: Mapping[str, str],
    call: Callable[..., "subprocess.CompletedProcess[str]"],
) -> None:
    done = call("curio-detect", models / "circles", frames[0].parent, extra=blocked)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [len(row["detections"]) for row in rows] == [1] * len(frames)


def test_the_server_works(
    models: Path, frames: list[Path], blocked: Mapping[str, str], serving: Callable[..., object]
) -> None:
    with serving(models, extra=blocked) as address, PoseClient(address) as client:
        assert len(client.detect("circles", frames[0]).results[0].detections) == 1


@pytest.mark.parametrize("through", ["track", "rig"])
def test_following_and_rigs_work(
    through: str, tmp_path: Path, blocked: Mapping[str, str], call: Callable[..., "subprocess.CompletedProcess[str]"]
) -> None:
    samples = ROOT / "samples"
    flags: list[str | Path] = [samples, "--camera", samples / "camera.json", "--track"]
    if through == "rig":
        camera = json.loads((samples / "camera.json").read_text())
        cameras = [camera | {"name": str(x), "cam_from_rig": beside(x)} for x in (0.0, 0.1)]
        (tmp_path / "rig.json").write_text(json.dumps({"cameras": cameras}))
        flags = [samples / "00.jpg", samples / "01.jpg", "--rig", tmp_path / "rig.json"]
    done = call("curio-detect", ROOT / "models" / "ape", *flags, extra=blocked)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == (1 if through == "rig" else 4)
    assert all(row["detections"] for row in rows)


def beside(x_m: float) -> list[list[float]]:
    """cam_from_rig, [4][4], of a camera that looks along the rig's axis, x_m to the left of it."""
    return [[1, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
