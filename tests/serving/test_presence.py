"""The probability that an object is in the image, beside the confidence in its pose."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_proto.v1.detector_pb2 import DetectResponse, Tracking
from curio_serve.batch.results.detection_json import detection_json
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model
from curio_serve.models.model_folder import open_model
from curio_serve.models.repeated import RepeatedReader
from curio_serve.tracking.stream import FollowingStream

ROOT = Path(__file__).parents[2]
CAMERA = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))


@pytest.fixture(scope="module")
def several() -> Model:
    return open_model(ROOT / "models" / "lmo").of(["ape", "can", "duck"])


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "03.jpg"))[..., ::-1])


def test_a_pose_is_at_most_as_certain_as_that_its_object_is_there(several: Model, pixels: np.ndarray) -> None:
    found = Detector(several).detect(pixels, CAMERA)[0].detections
    assert len(found) == 3
    for detection in found:
        assert 0 <= detection.confidence <= detection.presence + 1e-6 <= 1 + 1e-6
        assert detection_json(detection)["presence"] == pytest.approx(detection.presence, abs=1e-6)
    empty = Detector(several).detect(np.full_like(pixels, 128), CAMERA)[0].detections
    assert max(detection.presence for detection in empty) < max(detection.presence for detection in found)


def test_several_reads_answer_their_mean(several: Model, pixels: np.ndarray) -> None:
    matrix = CAMERA.matrix
    each = [several.run(camera.image(pixels, matrix)[None])["presence"] for camera in VIRTUAL_CAMERAS[:2]]
    found = RepeatedReader(several.spec, several.run, 2)(pixels[None])["presence"]
    np.testing.assert_allclose(found, np.mean(each, axis=0), atol=1e-6)


def test_followed_objects_have_it(several: Model, pixels: np.ndarray) -> None:
    stream, followed = FollowingStream(), DetectResponse()
    stream.follow(
        Tracking(time_s=0), [Detector(several)], pixels, CAMERA, min_confidence=0, reduction=1, results=followed.results
    )
    (alone,) = Detector(several).detect(pixels, CAMERA)
    expected = {detection.object: detection.presence for detection in alone.detections}
    found = {detection.object: detection.presence for detection in followed.results[0].detections}
    assert found
    assert found == {name: expected[name] for name in found}


def test_models_that_do_not_tell_it_answer_none(pixels: np.ndarray) -> None:
    (found,) = Detector(open_model(ROOT / "models" / "ape")).detect(pixels, CAMERA)[0].detections
    assert not found.HasField("presence")
    assert "presence" not in detection_json(found)
