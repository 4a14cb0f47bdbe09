"""Meshes given to drawings: those of the objects that were detected, in their unit."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_serve.imaging.camera import PinholeCamera
from curio_train.drawing.album import MeshFiles, draw
from curio_train.drawing.pictures import RenderOptions
from curio_train.errors import CurioError, DataError, UsageError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import to_ply
from curio_train.meshes.shapes import box
from curio_train.viewing.pages import Opening, open_pages
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 320, 240
CAMERA = PinholeCamera(np.array([[280.0, 0, 158.0], [0, 285.0, 121.0], [0, 0, 1]]), (-0.3, 0.1, 0.002, -0.001))
POSE = Pose(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([0.25, 0.1, 0.8]))
TALL, FLAT = box((0.1, 0.2, 0.3)), box((0.1, 0.2, 0.1))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, mesh in (("tall", TALL), ("flat", FLAT)):
        (tmp_path / f"{name}.ply").write_bytes(to_ply(mesh))
    return tmp_path


def found(folder: Path, *kinds: str, **changed: Any) -> Path:
    """A result file of the tall box under the given names, at the border of a distorted photograph."""
    corners_px = CAMERA.project(POSE.apply(TALL.box_corners_m)).tolist()
    detection = {
        "translation_m": POSE.translation_m.tolist(),
        "rotation": POSE.rotation.tolist(),
        "color": None,
        "confidence": 1.0,
        "box_px": corners_px,
    }
    record = {"image": None, "width": WIDTH, "height": HEIGHT, "camera_matrix": CAMERA.matrix.tolist()}
    detections = [detection | changed | {"object": kind} for kind in kinds]
    file = folder / "poses.jsonl"
    file.write_text(json.dumps(record | {"distortion": list(CAMERA.distortion), "detections": detections}))
    return file


def drawn(results: Path, *meshes: str, unit: Any = "m") -> list[Path]:
    """The pictures; curio-view opens the same pages, and refuses what curio-render does."""
    given = MeshFiles(meshes, unit)
    try:
        pictures = list(draw(results, results.parent / "drawn", given, None, RenderOptions()))
    except CurioError as refused:
        with pytest.raises(type(refused)):
            open_pages(Opening(str(results), given))
        raise
    assert len(open_pages(Opening(str(results), given))) == len(pictures)
    return pictures


def test_the_mesh_that_was_detected_is_drawn(folder: Path) -> None:
    assert len(drawn(found(folder, "tall"), f"{folder}/tall.ply")) == 1
    assert len(drawn(found(folder, "tall", "other"), f"tall={folder}/tall.ply", f"{folder}/tall.ply")) == 1


@pytest.mark.parametrize(("mesh", "unit"), [("flat", "m"), ("tall", "cm")])
def test_another_mesh_or_unit_is_refused(folder: Path, mesh: str, unit: str) -> None:
    with pytest.raises(DataError, match=r"the mesh is not the tall that was detected.*--mesh-unit"):
        drawn(found(folder, "tall"), f"{folder}/{mesh}.ply", unit=unit)


def test_one_mesh_for_two_kinds_is_refused(folder: Path) -> None:
    with pytest.raises(UsageError, match="--mesh flat=FILE --mesh tall=FILE"):
        drawn(found(folder, "tall", "flat"), f"{folder}/tall.ply")


@pytest.mark.parametrize("box_px", [None, [[None, None]] * 8])
def test_a_mesh_cannot_be_compared_without_a_box(folder: Path, box_px: Any) -> None:
    assert len(drawn(found(folder, "tall", box_px=box_px), f"{folder}/flat.ply")) == 1


@pytest.mark.parametrize("rotation", [np.diag([2.0, 2, 2]), np.diag([-1.0, 1, 1]), np.zeros((3, 3))], ids=str)
def test_what_is_no_rotation_is_not_drawn(folder: Path, rotation: np.ndarray) -> None:
    with pytest.raises(DataError, match="expected rows at right angles"):
        drawn(found(folder, "tall", rotation=rotation.tolist(), box_px=None), f"{folder}/tall.ply")


@pytest.mark.parametrize("form", ["glb", "usd", "rrd"])
def test_options_of_pictures_are_refused_for_other_formats(folder: Path, form: Any) -> None:
    options = RenderOptions(height=100, path_traced=True)
    with pytest.raises(UsageError, match="--height, --path-traced: for pictures"):
        list(draw(found(folder, "tall"), folder, MeshFiles((f"{folder}/tall.ply",), "m"), None, options, form))
    with pytest.raises(UsageError, match="--turn-deg nan"):
        RenderOptions(turn_deg=float("nan"))
