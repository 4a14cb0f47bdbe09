"""Images of the empty scene that lie among the photographs of parts on a plane."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.capture.plane import CameraPoseFile
from curio_train.doctor.examine import refuse_unfit
from curio_train.doctor.photographs import examine_photographs
from curio_train.errors import DataError
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


def on_a_plane(tmp_path: Path) -> CaptureOptions:
    """Options whose photographs, two images of the empty scene among them, are written."""
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
    return CaptureOptions(
        mesh=(tmp_path / "box.stl",),
        camera=tmp_path / "camera.json",
        photos=photos,
        mesh_unit="mm",
        background=photos / "empty.png",
        plane=tmp_path / "views.json",
        held_out=photos,
    )


def test_none_of_them_is_learned_from_judged_or_counted(tmp_path: Path) -> None:
    options = on_a_plane(tmp_path)
    photos = options.photos
    world = build(options)
    assert isinstance(world, TabletopWorld)
    assert len(world.photographs.training) == NUM
    assert world.photographs.own.names == [f"{number}.png" for number in range(NUM)]
    cameras = CameraPoseFile.read(tmp_path / "views.json")
    _, findings = examine_photographs(photos, None, empty_scenes(options, photos / "empty.png", cameras))
    assert any(f"only {NUM}, not counting empty.png and later.png" in str(finding) for finding in findings)
    assert not any("does not learn from them" in doubt for doubt in refuse_unfit(options)), "on a plane it does"


def test_broken_photographs_to_judge_by_are_told_before_training(tmp_path: Path) -> None:
    options = on_a_plane(tmp_path)
    judged = tmp_path / "judged"
    judged.mkdir()
    write(judged, "good.png", 130, 10)
    (judged / "torn.png").write_bytes((judged / "good.png").read_bytes()[:60])
    with pytest.raises(DataError, match=r"held-out: .*torn\.png"):
        refuse_unfit(replace(options, held_out=judged))
    with pytest.raises(DataError, match=r"second: .*torn\.png"):
        refuse_unfit(replace(options, second=judged, second_background=options.background))
