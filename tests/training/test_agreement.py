"""Photographs of a part in free space judge what was found in them: no label, a background image or none."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.evaluation.reporting.report_figures import samples
from curio_train.evaluation.unlabelled.agreement import differing, overlap
from curio_train.evaluation.unlabelled.closeups import CLOSEUP_PX
from curio_train.evaluation.unlabelled.photographed import Judgement, judge
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION
from curio_train.worlds import build
from curio_train.worlds.base import World
from curio_train.worlds.options import CaptureOptions
from torch import Tensor

WIDTH, HEIGHT, NUM = 160, 120, 5
Code = Mapping[str, Tensor]


def truth(world: World) -> dict[str, Tensor]:
    """Brackets near the middle of the frame, turned any way, of one colour, under the same light."""
    code = world.sample(NUM, (7,))
    code[TRANSLATION][:, 0] = torch.tensor([0.0, 0.01, 0.45]) + torch.linspace(-0.05, 0.05, NUM)[:, None]
    code[COLOR][:] = torch.tensor([0.8, 0.2, 0.15])
    code[LIGHT][:] = torch.tensor([0.2, -0.6, -0.5])
    return code | {CONFIDENCE: torch.ones(NUM, 1, 1)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs that the world itself draws over a mottled grey background image, with noise and less exposure."""
    root = tmp_path_factory.mktemp("agreement")
    base, tower = trimesh.creation.box((80, 40, 20)), trimesh.creation.box((20, 20, 50))
    tower.apply_translation((25, 0, 30))
    trimesh.util.concatenate([base, tower]).export(root / "bracket.stl")
    camera = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": WIDTH, "height": HEIGHT}
    (root / "camera.json").write_text(json.dumps(camera))
    random = np.random.default_rng(0)
    plate = cv2.resize(random.integers(110, 140, (12, 16, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    cv2.imwrite(str(root / "plate.png"), plate)
    (root / "photos").mkdir()
    cv2.imwrite(str(root / "photos" / "0.png"), plate)
    world = build(options(root))
    behind = torch.from_numpy(plate[..., ::-1].copy()).permute(2, 0, 1).float() / 255
    images = world.render(truth(world), behind.expand(NUM, -1, -1, -1)).permute(0, 2, 3, 1).numpy()
    noisy = images * 0.85 + random.normal(0, 0.01, images.shape)
    for number, image in enumerate((noisy.clip(0, 1) * 255).round().astype(np.uint8)):
        cv2.imwrite(str(root / "photos" / f"{number}.png"), image[..., ::-1])
    return root


def options(folder: Path, **changes: object) -> CaptureOptions:
    usual = {"mesh": (folder / "bracket.stl",), "camera": folder / "camera.json", "photos": folder / "photos"}
    return CaptureOptions(**{**usual, "mesh_unit": "mm", "background": folder / "plate.png"} | changes)  # type: ignore[arg-type]


def judged(world: World, code: Code) -> Judgement:
    found = judge(world, lambda _: dict(code))
    assert found is not None
    return found


WRONG: Mapping[str, Callable[[Code], Code]] = {
    "beside": lambda code: {TRANSLATION: code[TRANSLATION] + torch.tensor([0.05, 0.0, 0.0])},
    "turned": lambda code: {ROTATION_6D: code[ROTATION_6D].roll(3, dims=-1)},
    "far": lambda code: {TRANSLATION: 1.6 * code[TRANSLATION]},
}


@pytest.mark.parametrize("how", WRONG)
def test_true_poses_overlap_more_than_wrong_ones(folder: Path, how: str) -> None:
    world = build(options(folder))
    code = truth(world)
    right, wrong = judged(world, code), judged(world, code | WRONG[how](code))
    assert right.metrics["own_view_overlap"] > 0.9
    assert wrong.metrics["own_view_overlap"] < right.metrics["own_view_overlap"] - 0.15
    assert right.metrics["own_view_agreeing"] == 1
    assert right.verdict.startswith("Trust it: in 100% of 5")
    assert wrong.metrics["own_view_agreeing"] < 1


@pytest.mark.parametrize("how", ["beside", "far"])
def test_without_a_plate_what_stands_out_judges(folder: Path, how: str) -> None:
    world = build(options(folder, background=None))
    code = truth(world)
    right, wrong = judged(world, code), judged(world, code | WRONG[how](code))
    assert "own_view_overlap" not in right.metrics
    assert right.metrics["own_view_inside"] > 0.9, "exposure is allowed for"
    assert right.metrics["own_view_explained"] > 0.6
    assert wrong.metrics["own_view_explained"] < right.metrics["own_view_explained"] - 0.15
    assert "--background tells right from wrong better" in right.verdict
    assert right.metrics["own_view_agreeing"] == 1


def test_a_part_drawn_in_the_colours_of_its_surroundings_explains_nothing(folder: Path) -> None:
    world = build(options(folder, background=None))
    code = truth(world)
    hidden = WRONG["beside"](code) | {COLOR: torch.full((NUM, 1, 3), 0.55)}
    found = judged(world, code | hidden)
    assert found.metrics["own_view_agreeing"] == 0
    assert found.verdict.startswith("Do not trust it")


@pytest.mark.parametrize("background", [None, "plate.png"])
def test_a_part_that_is_found_outside_of_the_frame_explains_nothing(folder: Path, background: str | None) -> None:
    world = build(options(folder, background=background and folder / background))
    code = truth(world)
    found = judged(world, code | {TRANSLATION: code[TRANSLATION] + torch.tensor([9.0, 0.0, 0.0])})
    assert found.metrics["own_view_agreeing"] == 0
    assert found.verdict.startswith("Do not trust it")


def test_confidence_does_not_hide_what_was_found(folder: Path) -> None:
    world = build(options(folder))
    code = truth(world)
    unsure = code | {CONFIDENCE: torch.full((NUM, 1, 1), 0.01)}
    assert judged(world, unsure).metrics == judged(world, code).metrics


def test_close_ups_show_the_part_and_its_contour(folder: Path) -> None:
    """Of a right pose: the part fills much of the close-up, and the contour runs along its edge."""
    columns = judged(build(options(folder)), truth(build(options(folder)))).columns
    plain, outlined, drawn = (columns[name] for name in ("close-up", "its contour", "what was found"))
    assert plain.shape == outlined.shape == drawn.shape == (NUM, 3, CLOSEUP_PX, CLOSEUP_PX)
    inked = ((plain - outlined).abs().amax(dim=1) > 0.1).float().mean(dim=(1, 2))
    assert (inked > 0.005).all()
    assert (inked < 0.3).all(), "the inside stays visible"
    assert (plain - drawn).abs().mean() < 0.1


def test_photographs_with_nothing_in_them_are_counted(folder: Path, tmp_path: Path) -> None:
    for number in range(NUM):
        (tmp_path / f"{number}.png").write_bytes((folder / "plate.png").read_bytes())
    world = build(options(folder, photos=tmp_path))
    found = judged(world, truth(world))
    assert found.metrics["own_view_overlap"] == 0
    assert found.verdict.startswith("Do not trust it")
    assert "5 of them show nothing but the background image" in found.verdict


def test_the_worst_come_first_with_their_figures(folder: Path) -> None:
    world = build(options(folder))
    code = truth(world)
    code[TRANSLATION][3, 0, 0] += 0.15
    found = judged(world, code)
    paths, photographs = world.photographs.judged(NUM)
    assert torch.equal(found.columns["photograph"][0], photographs[3])
    assert found.captions[0].startswith(f"{paths[3].name}\n")
    assert "overlap 0.0" in found.captions[0]
    assert found.summary["num_photographs"] == NUM
    assert found.summary["metrics"]["own_view_agreeing"] == 0.8


def test_exposure_and_shadows_are_no_parts() -> None:
    random = torch.Generator().manual_seed(0)
    plate = 0.5 + 0.1 * torch.rand(3, 60, 80, generator=random)
    photograph = 0.8 * plate
    photograph[:, 5:25, 5:25] *= 0.5
    photograph[:, 30:50, 40:60] = torch.tensor([0.7, 0.1, 0.1])[:, None, None]
    part = torch.zeros(1, 60, 80, dtype=torch.bool)
    part[:, 30:50, 40:60] = True
    assert overlap(part, differing(photograph[None], plate)) == 1
    nothing = torch.zeros_like(part)
    assert overlap(nothing, differing(plate[None], plate)) == 1, "none is there and none was found"


def test_figures_stand_beside_their_rows() -> None:
    rows = torch.full((2, 3, 12, 16), 0.5)
    bare, scales, other = (
        samples([rows], ("photograph",), captions) for captions in ((), ("0.10", "0.9"), ("0.2", "1"))
    )
    assert len({bare, scales, other}) == 3
