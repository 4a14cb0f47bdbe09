"""One camera file means the same to training and to serving, or is refused by both."""

import json
from pathlib import Path

import numpy as np
import pytest
from curio_serve import errors as serving
from curio_serve.imaging.camera_files import read_camera_file
from curio_train.camera import load_intrinsics
from curio_train.errors import CameraError

K = [[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]]
SIZE = {"width": 640, "height": 480}
YAML = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [572.4, 0., 325.3, 0., 573.6, 242.0, 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [0.1, -0.2, 0.001, 0.002, 0.0]
"""
ROS_CALIBRATION = """image_width: 640
image_height: 480
camera_name: wrist
camera_matrix:
  rows: 3
  cols: 3
  data: [572.4, 0.0, 325.3, 0.0, 573.6, 242.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.001, 0.002, 0.0]
"""
ROS_ECHO = """header:
  frame_id: wrist
height: 480
width: 640
distortion_model: plumb_bob
d:
- 0.1
- -0.2
- 0.001
- 0.002
- 0.0
k:
- 572.4
- 0.0
- 325.3
- 0.0
- 573.6
- 242.0
- 0.0
- 0.0
- 1.0
binning_x: 0
---
"""
ROS_MESSAGE = {"distortion_model": "plumb_bob", **SIZE}
GOOD = {
    "json": {"camera_matrix": K, **SIZE},
    "json with whole floats": {"camera_matrix": K, "width": 640.0, "height": 480.0},
    "four coefficients": {"camera_matrix": K, "distortion": [0.1, 0, 0, 0], **SIZE},
    "eight coefficients": {"camera_matrix": K, "distortion": [0.1, 0, 0, 0, 0, 0, 0, 0], **SIZE},
    "bop": {"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "depth_scale": 1.0, **SIZE},
    "yaml": YAML,
    "ros calibration": ROS_CALIBRATION,
    "ros topic echo": ROS_ECHO,
    "ros 1 message": {"K": np.ravel(K).tolist(), "D": [0.1, 0, 0, 0, 0], **ROS_MESSAGE},
    "ros 2 message": {"k": np.ravel(K).tolist(), "d": [], **ROS_MESSAGE},
}
BAD = {
    "skew of a pixel": {"camera_matrix": [[572.4, 1, 325.3], *K[1:]], **SIZE},
    "transposed": {"camera_matrix": np.transpose(K).tolist(), **SIZE},
    "focal length in image widths": {"camera_matrix": [[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]], **SIZE},
    "very short focal length": {"camera_matrix": [[40, 0, 320], [0, 40, 240], [0, 0, 1]], **SIZE},
    "centre outside": {"camera_matrix": [[572.4, 0, 900], *K[1:]], **SIZE},
    "half a pixel": {"camera_matrix": K, "width": 640.5, "height": 480},
    "three coefficients": {"camera_matrix": K, "distortion": [0.1, 0, 0], **SIZE},
    "coefficients as text": {"camera_matrix": K, "distortion": "none", **SIZE},
    "no matrix": SIZE,
    "fisheye lens": {"k": np.ravel(K).tolist(), "d": [0.1, 0, 0, 0], **SIZE, "distortion_model": "equidistant"},
    "skew of a focal length": {"camera_matrix": [[572.4, 573, 325.3], *K[1:]], **SIZE},
    "no json": "{",
}


def write(folder: Path, content: object) -> Path:
    path = folder / ("camera.yaml" if isinstance(content, str) and ": " in content else "camera.json")
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("content", GOOD.values(), ids=GOOD.keys())
def test_both_read_the_same(tmp_path: Path, content: object) -> None:
    path = write(tmp_path, content)
    served, trained = read_camera_file(path).camera, load_intrinsics(path)
    assert served is not None
    assert np.array_equal(served.matrix, trained.matrix)
    assert served.size == (trained.width, trained.height) == (640, 480)
    assert served.distortion == trained.distortion


@pytest.mark.parametrize("content", BAD.values(), ids=BAD.keys())
def test_both_refuse_the_same(tmp_path: Path, content: object) -> None:
    path = write(tmp_path, content)
    with pytest.raises(serving.CameraError) as served:
        read_camera_file(path)
    with pytest.raises(CameraError) as trained:
        load_intrinsics(path)
    assert str(served.value) == str(trained.value)
    assert str(path) in str(served.value)


def test_training_needs_one_camera_of_known_size(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="no width and height"):
        load_intrinsics(write(tmp_path, {"camera_matrix": K}))
    with pytest.raises(CameraError, match="K for each image"):
        load_intrinsics(write(tmp_path, {"0": {"cam_K": np.ravel(K).tolist()}}))
