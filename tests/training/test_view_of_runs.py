"""curio-view of run folders: newer checkpoints, edits that they must not lose, and the frames of parts on a plane."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.drawing import pictures
from curio_train.drawing.album import MeshFiles
from curio_train.drawing.pictures import RenderOptions, picture
from curio_train.errors import UsageError
from curio_train.evaluation.subject import load_subject
from curio_train.geometry import camera_looking_at
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import index
from curio_train.viewing.pages import Opening, newer_pages, open_pages
from curio_train.viewing.saving import save
from curio_train.worlds.options import CaptureOptions, SpheresOptions

WIDTH, HEIGHT = 96, 72


def test_a_run_is_opened_again_with_a_newer_checkpoint(tmp_path: Path, write_run: Callable[..., Path]) -> None:
    run = write_run(tmp_path / "run", SpheresOptions())
    opening = Opening(str(run), cache=tmp_path)
    pages, reload = open_pages(opening), newer_pages(opening)
    assert reload() is None
    (checkpoint,) = (run / "checkpoints").iterdir()
    shutil.copytree(checkpoint, checkpoint.with_name("00000009"))
    again = reload()
    assert again is not None
    assert [page.scene.name for page in again] == [page.scene.name for page in pages]
    assert reload() is None


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory, write_run: Callable[..., Path]) -> Path:
    """A run of wedges on a grey plane; neither the file's origin nor its axes are the world's."""
    root = tmp_path_factory.mktemp("plane")
    corners = [[30, 0, 0], [110, 0, 0], [30, 40, 0], [110, 40, 0], [30, 0, 50], [30, 40, 50]]
    trimesh.Trimesh(corners).convex_hull.export(root / "wedge.stl")
    matrix = [[110.0, 0, 47.5], [0, 110, 35.5], [0, 0, 1]]
    (root / "camera.json").write_text(json.dumps({"camera_matrix": matrix, "width": WIDTH, "height": HEIGHT}))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera_looking_at(torch.tensor([0.0, 0.5, 0.55]).double(), torch.zeros(3).double())
    (root / "views.json").write_text(json.dumps({"empty.png": {"cam_from_world": pose.tolist()}}))
    empty = np.full((HEIGHT, WIDTH, 3), 130, np.uint8)
    cv2.imwrite(str(root / "empty.png"), empty)
    (root / "photos").mkdir()
    for number in range(100):
        photo = empty.copy()
        photo[20:60, 10 + number % 50 : 40 + number % 50] = 40
        cv2.imwrite(str(root / "photos" / f"{number:02}.png"), photo)
    files = {"camera": root / "camera.json", "photos": root / "photos", "plane": root / "views.json"}
    parts = {"mesh": (root / "wedge.stl",), "mesh_unit": "mm", "counts": ("2",), "lying": True}
    return write_run(root / "run", CaptureOptions(**files, **parts, background=root / "empty.png"))  # type: ignore[arg-type]


def test_parts_on_a_plane_are_drawn_where_the_world_renders_them(plane: Path, tmp_path: Path) -> None:
    page = open_pages(Opening(str(plane), cache=tmp_path))[0]
    drawn = picture(page.scene, page.context, RenderOptions(), photograph=page.image).astype(np.float64)
    subject = load_subject(plane)
    image = torch.from_numpy(page.image).permute(2, 0, 1)[None]
    rendered = subject.world.render(index(subject.predict(image), slice(0, 1)), backgrounds=image.float() / 255)
    world = 255 * rendered[0].permute(1, 2, 0).double().numpy()
    part = np.abs(drawn - page.image).max(axis=2) > 20  # the world renders shadows, too
    assert page.over_image
    assert part.sum() > 50
    assert np.abs(drawn - world)[part].mean() < 0.1 * np.abs(drawn - page.image)[part].mean()


def test_a_large_picture_is_drawn_in_rounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = open_pages(Opening("chairs", cache=tmp_path))[0]
    whole = picture(page.scene, page.context, RenderOptions()).astype(np.float64)
    rounds: list[int] = []
    render = Renderer.__call__
    monkeypatch.setattr(Renderer, "__call__", lambda *args, **kw: rounds.append(kw["seed"]) or render(*args, **kw))
    monkeypatch.setattr(pictures, "MAX_RAYS", 50_000)
    parts = picture(page.scene, page.context, RenderOptions()).astype(np.float64)
    assert len(set(rounds)) > 3
    assert np.abs(parts - whole).mean() < 0.5


def test_a_folder_of_runs_is_no_folder_of_photographs(plane: Path) -> None:
    with pytest.raises(UsageError, match=re.escape(f"{plane.parent}: holds runs; give one of them, such as {plane}")):
        open_pages(Opening(str(plane.parent)))


def test_an_edited_scene_of_a_run_is_opened_again(plane: Path, tmp_path: Path) -> None:
    page = open_pages(Opening(str(plane), cache=tmp_path))[1]
    out = tmp_path / "edited.jsonl"
    save(page, out)
    save(page, out)
    again, _ = open_pages(Opening(str(out), MeshFiles((str(plane.parent / "wedge.stl"),), "mm")))
    np.testing.assert_array_equal(again.image, page.image)
    for item, other in zip(again.scene.objects, page.scene.objects, strict=True):
        np.testing.assert_allclose(item.pose.translation_m, other.pose.translation_m)
        np.testing.assert_allclose(again.context.mesh("wedge").vertices_m, page.context.mesh("wedge").vertices_m)
    assert len(list(tmp_path.glob("edited-*.png"))) == 1  # of the same image
