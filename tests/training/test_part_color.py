"""The colour of an unpainted part: found in photographs over a background image, or not; and what is drawn about it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.camera import load_intrinsics
from curio_train.commands.prepare import prepared
from curio_train.config import RunConfig, WorldOptions
from curio_train.data.part_color import find_color
from curio_train.errors import UsageError
from curio_train.scene_code import COLOR, CONFIDENCE
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions, srgb_of
from curio_train.worlds.single_object.base_colors import any_base_color, base_colors_near

WIDTH, HEIGHT = 160, 120
SRGB = {"red": (0.78, 0.2, 0.16), "pale": (0.8, 0.78, 0.7), "black": (0.08, 0.08, 0.1), "teal": (0.1, 0.5, 0.5)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unpainted part, a camera and a grey background image."""
    root = tmp_path_factory.mktemp("part")
    trimesh.creation.box((0.09, 0.05, 0.03)).export(root / "block.stl")
    camera = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": WIDTH, "height": HEIGHT}
    (root / "camera.json").write_text(json.dumps(camera))
    grain = np.random.default_rng(0).normal(0, 1, (HEIGHT, WIDTH, 1))
    coarse = cv2.resize(np.random.default_rng(1).normal(0, 1, (6, 8)), (WIDTH, HEIGHT))[..., None]
    save(root / "plate.png", (np.array([150, 146, 138]) + 3 * grain + 9 * coarse) / 255)
    return root


def save(path: Path, srgb: np.ndarray) -> None:
    cv2.imwrite(str(path), (srgb[..., ::-1].clip(0, 1) * 255).round().astype(np.uint8))


def take(folder: Path, colors: list[tuple[float, float, float]], confidence: float = 1.0) -> CaptureOptions:
    """A photograph of each colour: with a shadow beside the part, noise, and exposure and white balance of its own."""
    photos = folder / f"photos-{abs(hash((tuple(colors), confidence)))}"
    photos.mkdir()
    mesh, camera = (folder / "block.stl",), folder / "camera.json"
    options = CaptureOptions(mesh, camera, photos, background=folder / "plate.png")
    world, random = build(options), np.random.default_rng(2)
    code = world.sample(len(colors), (3,))
    code |= {COLOR: torch.tensor(colors).float()[:, None], CONFIDENCE: torch.full((len(colors), 1, 1), confidence)}
    plate = cv2.cvtColor(cv2.imread(str(options.background)), cv2.COLOR_BGR2RGB) / 255
    behind = np.stack([plate * _shadow(random, confidence) for _ in colors])
    images = world.render(code, torch.from_numpy(behind).permute(0, 3, 1, 2).float()).permute(0, 2, 3, 1).numpy()
    for number, image in enumerate(images):
        gain = random.uniform(0.9, 1.1) * random.uniform(0.97, 1.03, 3)
        save(photos / f"{number:02}.png", image * gain + random.normal(0, 0.015, image.shape))
    return options


def _shadow(random: np.random.Generator, depth: float) -> np.ndarray:
    dark = np.zeros((HEIGHT, WIDTH), np.float32)
    cv2.ellipse(dark, [int(v) for v in random.integers(30, 90, 2)], (14, 8), 0, 0, 360, 1.0, -1)
    return 1 - 0.3 * depth * cv2.GaussianBlur(dark, (9, 9), 0)[..., None]


def found_in(options: CaptureOptions) -> np.ndarray | None:
    assert options.background is not None
    found = find_color(options.photos, options.background, load_intrinsics(options.camera))
    return None if found is None else np.frombuffer(bytes.fromhex(found.hex[1:]), np.uint8) / 255


@pytest.mark.parametrize("name", SRGB)
def test_a_colour_is_found_in_photographs_that_differ_in_light(folder: Path, name: str) -> None:
    found = found_in(take(folder, [SRGB[name]] * 16))
    assert found is not None
    true = np.array(SRGB[name])
    assert np.abs(found / found.max() - true / true.max()).max() < 0.15
    assert 0.6 < found.max() / true.max() < 1.5, "what is drawn about it covers the true value"


def test_where_photographs_do_not_tell_a_colour_none_is_found(folder: Path) -> None:
    assert found_in(take(folder, [SRGB["red"]] * 8, confidence=0.0)) is None, "nothing but the background image"
    several = [SRGB["red"], SRGB["teal"], (0.2, 0.2, 0.9), (0.8, 0.8, 0.1)]
    assert found_in(take(folder, several * 3)) is None, "parts of several colours"
    options = take(folder, [SRGB["red"]] * 6 + [SRGB["teal"]] * 2)
    assert options.background is not None
    mostly = find_color(options.photos, options.background, load_intrinsics(options.camera))
    assert mostly is not None
    assert (mostly.num_used, mostly.num_compared) == (6, 8)
    options = take(folder, [SRGB["red"]] * 4)
    random = np.random.default_rng(4)
    save(folder / "other.png", cv2.resize(random.random((6, 8, 3)), (WIDTH, HEIGHT)))
    assert found_in(replace(options, background=folder / "other.png")) is None, "the background image of another scene"
    assert found_in(take(folder, [SRGB["red"]] * 2)) is None, "too few to believe"


def prepare(options: CaptureOptions, folder: Path) -> tuple[WorldOptions, str]:
    """The options of a run, but for the names of its photographs and meshes, and what was said."""
    said: list[str] = []
    world = prepared(RunConfig(options), folder, lambda _: None, said.append).world
    assert isinstance(world, CaptureOptions)
    assert world.judged
    return replace(world, judged=(), mesh_sha256=()), "\n".join(said)


def test_a_run_keeps_the_colour_that_was_found(folder: Path) -> None:
    options = take(folder, [SRGB["teal"]] * 8)
    among = shutil.copy(folder / "plate.png", options.photos)  # and is none of them
    options = replace(options, background=Path(among))
    kept, said = prepare(options, folder)
    assert isinstance(kept, CaptureOptions)
    assert kept.paint is not None
    assert f"of 8 photographs: {kept.paint}" in said
    assert prepare(replace(options, paint="#112233"), folder) == (replace(options, paint="#112233"), "")
    alone = replace(options, background=None)
    assert prepare(alone, folder)[0] == alone
    assert "--background" in prepare(alone, folder)[1]
    colors = build(kept).sample(200, (0,))[COLOR][:, 0]
    assert 0.6 < ((colors[:, 0] < colors[:, 1]) & (colors[:, 0] < colors[:, 2])).double().mean() < 0.97


def test_a_part_that_has_colours_takes_no_paint(folder: Path) -> None:
    shape = trimesh.creation.box((0.09, 0.05, 0.03))
    shape.visual.vertex_colors = np.tile([200, 30, 30, 255], (len(shape.vertices), 1))
    shape.export(folder / "red.ply")
    options = replace(take(folder, [SRGB["red"]]), mesh=(folder / "red.ply",))
    assert prepare(options, folder) == (options, "")
    with pytest.raises(UsageError, match="colours of its own"):
        build(replace(options, paint="#112233"))


def test_paint_is_drawn_about_its_colour_and_now_and_then_anywhere() -> None:
    drawn = base_colors_near(srgb_of("#8a6f4c"))(2000, np.random.default_rng(0))
    assert drawn.shape == (2000, 1, 3)
    assert torch.equal(drawn, base_colors_near(srgb_of("8a6f4c"))(2000, np.random.default_rng(0)))
    tints = drawn / drawn.amax(-1, keepdim=True)
    near = (tints - torch.tensor([0x8A, 0x6F, 0x4C]) / 0x8A).abs().amax(-1)[:, 0] < 0.2
    assert 0.8 < near.double().mean() < 0.95
    values = drawn[near].amax(-1)
    assert values.min() < 0.65 * 0x8A / 255
    assert values.max() > 1.4 * 0x8A / 255
    black = base_colors_near(srgb_of("#000000"))(200, np.random.default_rng(0))
    assert (black.amax(-1) <= 0.08).double().mean() > 0.7
    anything = any_base_color(2000, np.random.default_rng(0))
    assert anything.amin() < 0.05 < 0.95 < anything.amax()
    for wrong in ("red", "#12345", "#1122334"):
        with pytest.raises(UsageError, match="#8a6f4c"):
            srgb_of(wrong)
        with pytest.raises(UsageError, match=f"--paint {wrong}"):  # before files are looked at
            CaptureOptions((Path("none.ply"),), Path("none.json"), Path("none"), paint=wrong)
