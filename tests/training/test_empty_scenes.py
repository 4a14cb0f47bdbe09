"""Images of the empty scene that lie among the photographs of parts on a plane."""

import json
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from curio_train.capture.plane import CameraPoseFile
from curio_train.doctor.examine import refuse_unfit
from curio_train.doctor.photographs import examine_photographs
from curio_train.geometry import camera_looking_at
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.tabletop.files import empty_scenes
from curio_train.worlds.tabletop.world import TabletopWorld

WIDTH, HEIGHT, NUM = 96, 72, 4


def write(folder: Path, name: str, level: int, part_at: int | None = None) -> None:
    picture = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    if part_at is not None:
        picture[20:60, part_at : part_at + 30] = 40
    cv2.imwrite(str(folder / name), picture)


def test_none_of_them_is_learned_from_judged_or_counted(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(NUM):
        write(photos, f"{number}.png", 130, 10 + 15 * number)
    write(photos, "empty.png", 130)
    write(photos, "later.png", 135)
    trimesh.creation.box((60.0, 40.0, 30.0)).export(tmp_path / "box.stl")
    matrix = [[110.0, 0, 47.5], [0, 110, 35.5], [0, 0, 1]]
    (tmp_path / "camera.json").write_text(json.dumps({"camera_matrix": matrix, "width": WIDTH, "height": HEIGHT}))
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = camera_looking_at(torch.tensor([0.0, 0.5, 0.55]).double(), torch.zeros(3).double())
    entry = {"cam_from_world": camera.tolist()}
    of_photo = entry | {"plate": "photos/later.png"}
    (tmp_path / "views.json").write_text(json.dumps({"empty.png": entry, "3.png": of_photo}))
    options = CaptureOptions(
        mesh=(tmp_path / "box.stl",),
        camera=tmp_path / "camera.json",
        photos=photos,
        mesh_unit="mm",
        background=photos / "empty.png",
        plane=tmp_path / "views.json",
        held_out=photos,
    )
    world = build(options)
    assert isinstance(world, TabletopWorld)
    assert len(world.photographs.training) == NUM
    assert world.photographs.own.names == [f"{number}.png" for number in range(NUM)]
    cameras = CameraPoseFile.read(tmp_path / "views.json")
    _, findings = examine_photographs(photos, None, empty_scenes(options, photos / "empty.png", cameras))
    assert any(f"only {NUM}, not counting empty.png and later.png" in str(finding) for finding in findings)
    assert not any("does not learn from them" in doubt for doubt in refuse_unfit(options)), "on a plane it does"
