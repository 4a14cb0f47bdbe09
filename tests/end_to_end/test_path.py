"""From images without labels to poses over gRPC, through the commands a user types."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_serve.client import PoseClient
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.scene_code import TRANSLATION
from curio_train.worlds import build

TOLERANCE = 1e-5  # image widths


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


def test_run_and_model_get_the_same_marks(run: Path, models: Path, call: Callable[..., object], tmp_path: Path) -> None:
    flags = ["--num-images", "60", "--cache", run.parent / "cache", "--json"]
    of_run, of_model = (
        json.loads(call("curio-eval", path, *flags).stdout.splitlines()[-1]) for path in (run, models / "circles")
    )
    assert of_run["num_images"] == of_model["num_images"] == 60
    for name, value in of_run["metrics"].items():
        assert of_model["metrics"][name] == pytest.approx(value, rel=1e-4), name
    assert of_model["untrained"] == of_run["untrained"]
    assert of_run["untrained"] != of_run["metrics"]
    kept = json.loads((run / "evaluation.json").read_text())
    assert kept == of_run
