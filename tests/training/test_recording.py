"""Results as a Rerun recording: Rerun's own reader finds photographs, cameras, boxes and confidence at their time."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from curio_train.drawing.album import MeshFiles, draw
from curio_train.drawing.pictures import RenderOptions
from curio_train.errors import DataError
from curio_train.meshes.shapes import box
from rerun.chunk import RrdReader

K = [[600.0, 0.0, 319.5], [0.0, 610.0, 245.0], [0.0, 0.0, 1.0]]


def line(image: Path, *objects: tuple[str, float]) -> str:
    detections = [
        {
            "object": name,
            "confidence": confidence,
            "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
            "translation_m": [0.1, 0.2, 0.7],
            "color": None,
        }
        for name, confidence in objects
    ]
    return json.dumps(
        {"image": str(image), "width": 640, "height": 480, "camera_matrix": K, "detections": detections, "light": None}
    )


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    shape = box((0.1, 0.2, 0.3))
    path = tmp_path / "box.ply"
    trimesh.Trimesh(shape.vertices_m + np.array([0, 0, 0.05]), shape.faces, process=False).export(path)
    return path


def record(lines: list[str], mesh: Path, folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows of each entity of the recording of these lines."""
    results = folder / "poses.jsonl"
    results.write_text("\n".join(lines))
    (path,) = draw(results, folder / "out", MeshFiles((str(mesh),), "m"), None, RenderOptions(), "rrd")
    assert path == folder / "out" / "poses.rrd"
    batches = [(chunk.entity_path, chunk.to_record_batch()) for chunk in RrdReader(path).stream()]
    clock = {"log_time", "RecordingInfo:start_time"}  # finer than Python's time
    return {
        entity: batch.select([name for name in batch.schema.names if name not in clock]).to_pylist()
        for entity, batch in batches
    }


def test_a_recording_holds_every_frame(tmp_path: Path, mesh: Path) -> None:
    images = [tmp_path / f"{number}.png" for number in range(3)]
    for number, image in enumerate(images):
        cv2.imwrite(str(image), np.full((480, 640, 3), 50 * number, np.uint8))
    found = [("bracket", 0.9), ("bracket", 0.4)], [], [("bracket", 0.7)]
    rows = record([line(image, *objects) for image, objects in zip(images, found, strict=True)], mesh, tmp_path)

    assert [row["image"] for row in rows["/camera"]] == [0, 1, 2]
    assert pytest.approx(np.array(K)) == np.reshape(rows["/camera"][0]["Pinhole:image_from_camera"], (3, 3)).T
    blobs = [bytes(row["EncodedImage:blob"][0]) for row in rows["/camera/image"]]
    assert blobs == [image.read_bytes() for image in images]

    boxes = rows["/camera/boxes"]
    assert [len(row["Boxes3D:half_sizes"]) for row in boxes] == [2, 0, 1]  # what is gone is gone
    assert boxes[2]["Boxes3D:half_sizes"][0] == pytest.approx([0.05, 0.1, 0.15])
    assert boxes[2]["Boxes3D:centers"][0] == pytest.approx([0.1, 0.2, 0.75])  # the mesh's middle is off its origin
    assert boxes[2]["Boxes3D:quaternions"][0] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    assert boxes[2]["Boxes3D:labels"] == ["bracket 0.70"]

    curve = [(row["image"], row["Scalars:scalars"][0]) for row in rows["/confidence/bracket/0"]]
    assert curve == [(0, 0.9), (2, 0.7)]


@pytest.mark.parametrize(
    ("name", "encoding", "media_type", "is_own_file"),
    [
        ("a.png", ".png", "image/png", True),
        ("a.JPG", ".jpg", "image/jpeg", True),
        ("a.jpg", ".png", "image/png", True),
        ("a.webp", ".webp", "image/jpeg", False),
        ("a.bmp", ".bmp", "image/jpeg", False),
    ],
)
def test_images_are_what_their_media_type_says(
    tmp_path: Path, mesh: Path, name: str, encoding: str, media_type: str, is_own_file: bool
) -> None:
    """Whatever the file is called; Rerun shows JPEG and PNG alone."""
    pixels = np.full((480, 640, 3), (40, 120, 200), np.uint8)
    content = cv2.imencode(encoding, pixels)[1].tobytes()
    (tmp_path / name).write_bytes(content)
    (row,) = record([line(tmp_path / name)], mesh, tmp_path)["/camera/image"]
    blob = bytes(row["EncodedImage:blob"][0])
    assert row["EncodedImage:media_type"] == [media_type]
    assert blob.startswith(b"\x89PNG" if media_type == "image/png" else b"\xff\xd8\xff")
    assert (blob == content) == is_own_file
    assert np.abs(cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_COLOR).astype(int) - pixels).max() < 8


def test_a_photograph_that_is_gone_is_named(tmp_path: Path, mesh: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.png: the photograph cannot be read"):
        record([line(tmp_path / "gone.png")], mesh, tmp_path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, mesh: Path) -> None:
    (tmp_path / "out").write_text("a file in its place")
    with pytest.raises(DataError, match="the folder cannot be made"):
        record([line(tmp_path / "a.png")], mesh, tmp_path)
