"""curio-view in a real browser: open, drag, fit, save, reload."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import viser
from curio_serve.models.model_folder import open_model
from curio_train.commands import view as view_command
from curio_train.data.clutter import dead_leaves_texture
from curio_train.drawing.album import MeshFiles
from curio_train.drawing.pictures import RenderOptions, SceneContext, picture
from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import load_mesh
from curio_train.meshes.shapes import chair
from curio_train.viewing.comparison import compare
from curio_train.viewing.fitting import walk
from curio_train.viewing.pages import Opening, Page, open_pages
from curio_train.viewing.saving import save
from curio_train.viewing.space import Space
from curio_train.worlds.options import SpheresOptions
from scipy.spatial.transform import Rotation

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT = 320, 240
K = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
TRUE = Pose(Rotation.from_euler("xyz", [160, 35, 10], degrees=True).as_matrix(), np.array([0.01, 0.02, 0.6]))
OFF = Pose(np.eye(3), np.array([0.3, -0.1, 0.4]))
WINDOW = (1600, 800)

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium on this machine; .ci/run installs it where it can"
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh, a rendering of it over clutter, and a result file whose pose is off by 9 mm and 7 degrees."""
    folder = tmp_path_factory.mktemp("viewing")
    mesh = chair(0.15)
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    shade = np.linspace(60, 240, len(mesh.vertices_m))[:, None] * [1.0, 0.8, 0.6]
    solid.visual.vertex_colors = shade.astype(np.uint8)
    solid.export(folder / "chair.ply")
    clutter = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    dead_leaves_texture(clutter, np.random.default_rng(2))
    scene = Scene("photograph", WIDTH, HEIGHT, K, (Placed("chair", TRUE),), None, folder / "photograph.png")
    context = SceneContext({"chair": load_mesh(folder / "chair.ply", "m")})
    drawn = picture(scene, context, RenderOptions(), photograph=(255 * clutter.clip(0, 1)).astype(np.uint8))
    cv2.imwrite(str(folder / "photograph.png"), drawn[..., ::-1])
    off = Rotation.from_rotvec([4.0, -5.0, 3.0], degrees=True).as_matrix()
    wrong = Pose(off @ TRUE.rotation, TRUE.translation_m + np.array([0.006, -0.005, 0.005]))
    found = Scene("", WIDTH, HEIGHT, K, (Placed("chair", wrong),), None, folder / "photograph.png")
    save(Page(found, context, drawn, over_image=True), folder / "found.jsonl")
    return folder


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


class Command:
    """A running ``curio-view``."""

    def __init__(self, *arguments: str | Path, before: str = "", **environment: str) -> None:
        self.port = free_port()
        script = f"{before}\nfrom curio_train.commands.view import view; view()"
        given = [sys.executable, "-c", script, *map(str, arguments), "--port", str(self.port)]
        full = {**os.environ, **environment}
        self.process = subprocess.Popen(given, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=full)
        assert self.process.stderr is not None
        self.url = f"http://127.0.0.1:{self.port}"
        assert f"{self.url}, for this machine alone" in self.process.stderr.readline()


@pytest.fixture(scope="module")
def terminated() -> Iterator[list[Command]]:
    """Commands that were told to end. They take a second or two for it, in which the next test begins."""
    commands: list[Command] = []
    yield commands
    assert [command.process.wait(20) for command in commands] == [143] * len(commands)


@pytest.fixture
def view(terminated: list[Command]) -> Iterator[Callable[..., Command]]:
    started: list[Command] = []

    def start(*arguments: str | Path, before: str = "", **environment: str) -> Command:
        started.append(Command(*arguments, before=before, **environment))
        return started[-1]

    yield start
    for command in started:
        command.process.terminate()
        terminated.append(command)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        found = started.chromium.launch(executable_path=BROWSER, args=options)
        yield found
        found.close()


def opened(browser: Any, url: str) -> Any:
    page = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
    page.goto(url)
    page.get_by_text("image loss").wait_for(timeout=180_000)
    return page


def loss(page: Any) -> float:
    match = re.search(r"image loss ([\d.e+]+)", page.get_by_text("image loss").inner_text())
    assert match is not None
    return float(match[1])


def re_rendering(page: Any) -> str:
    return str(page.locator("img").evaluate_all("images => images.map(image => image.src).join()"))


def until(met: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)


def gizmo_arrow_px(pose: Pose, scale_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the gizmo's x arrow begins and ends in the window, which has the camera's vertical field of view."""
    focal_px = K[1, 1] * WINDOW[1] / HEIGHT
    ends = np.array([pose.translation_m, pose.translation_m + scale_m * pose.rotation[:, 0]])
    start, end = ends[:, :2] / ends[:, 2:] * focal_px + np.array(WINDOW) / 2
    return start, end


def drag(page: Any, start: np.ndarray, end: np.ndarray) -> None:
    """With pauses, because the browser must have drawn what is under the pointer."""
    for position in (start - 1, start):
        page.mouse.move(*position)
        page.wait_for_timeout(1000)
    page.mouse.down()
    for fraction in np.linspace(0, 1, 6):
        page.mouse.move(*(start + fraction * (end - start)))
        page.wait_for_timeout(100)
    page.mouse.up()


@needs_browser
def test_drag_fit_save_and_reload(files: Path, view: Callable[..., Command], browser: Any) -> None:
    out = files / "edited.jsonl"
    command = view(files / "found.jsonl", "--mesh", files / "chair.ply", "--out", out)
    page = opened(browser, command.url)
    other = opened(browser, command.url)
    before, seen = loss(page), re_rendering(page)
    (record,) = [json.loads(line) for line in (files / "found.jsonl").read_text().splitlines()]
    start_pose = Pose(*(np.array(record["detections"][0][name]) for name in ("rotation", "translation_m")))
    start, end = gizmo_arrow_px(start_pose, 0.6 * load_mesh(files / "chair.ply", "m").diameter_m)
    grip = start + 0.8 * (end - start)
    drag(page, grip, grip + 0.15 * (end - start))
    until(lambda: loss(page) != before and re_rendering(page) != seen)
    other.close()  # a browser that leaves in the middle
    page.get_by_role("button", name="fit this object").click()
    page.get_by_text("fit: done").wait_for(timeout=300_000)
    until(lambda: loss(page) < before / 2)
    page.get_by_role("button", name="save the code").click()
    page.get_by_text("saved to").wait_for()
    (saved,) = [json.loads(line) for line in out.read_text().splitlines()]
    found = saved["detections"][0]
    assert np.array(found["translation_m"]) == pytest.approx(TRUE.translation_m, abs=0.002)
    turned = Rotation.from_matrix(np.array(found["rotation"]).T @ TRUE.rotation).magnitude()
    assert np.degrees(turned) < 2
    page.reload()
    page.get_by_text("image loss").wait_for(timeout=180_000)
    until(lambda: loss(page) < before / 2)
    page.close()


@needs_browser
def test_scenes_of_a_world(files: Path, view: Callable[..., Command], browser: Any) -> None:
    page = opened(browser, view("chairs", "--out", files / "chairs.jsonl").url)
    assert page.get_by_text("000000-chairs").is_visible()
    assert loss(page) < 20  # rendered from its own code: what is left is sampling noise
    page.close()


@needs_browser
def test_newer_checkpoints_leave_what_is_not_saved(
    tmp_path: Path, write_run: Callable[..., Path], view: Callable[..., Command], browser: Any
) -> None:
    run = write_run(tmp_path / "run", SpheresOptions())
    few = "from curio_train.worlds import image_sets; image_sets.NUM_IMAGES |= {'validation': 8}"
    page = opened(browser, view(run, "--out", tmp_path / "edited.jsonl", "--cache", tmp_path, before=few).url)
    (checkpoint,) = (run / "checkpoints").iterdir()
    across = page.get_by_label("position (mm)")
    read = across.input_value()
    across.fill("123.4")
    page.wait_for_timeout(1000)
    shutil.copytree(checkpoint, checkpoint.with_name("00000009"))
    page.get_by_text("There is a newer checkpoint").wait_for(timeout=60_000)
    assert across.input_value() == "123.4"
    page.get_by_role("button", name="save the code").click()
    page.get_by_text("saved to").wait_for()
    shutil.copytree(checkpoint, checkpoint.with_name("00000010"))
    until(lambda: across.input_value() == read)
    page.close()


@needs_browser
def test_a_photograph_with_a_model(files: Path, view: Callable[..., Command], browser: Any) -> None:
    given = ["--model", ROOT / "models" / "ape", "--camera", ROOT / "samples" / "camera.json"]
    corners_m = np.reshape(open_model(ROOT / "models" / "ape").spec.objects[0].box_corners_m, (8, 3))
    trimesh.PointCloud(corners_m).convex_hull.export(files / "ape.ply")  # as large as the ape: others are refused
    out = files / "ape.jsonl"
    command = view(ROOT / "samples" / "00.jpg", *given, "--mesh", files / "ape.ply", "--out", out)
    page = opened(browser, command.url)
    assert page.get_by_text("640x480 pixels").is_visible()
    page.close()


@needs_browser
def test_without_a_renderer_the_photograph_is_shown(
    files: Path, view: Callable[..., Command], browser: Any, tmp_path: Path
) -> None:
    given = [files / "found.jsonl", "--mesh", files / "chair.ply", "--out", tmp_path / "edited.jsonl"]
    command = view(*given, DRJIT_LIBLLVM_PATH=str(tmp_path / "nowhere.so"))
    page = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
    page.goto(command.url)
    page.get_by_text("libLLVM").wait_for(timeout=180_000)  # what is missing, and what installs it
    until(lambda: "data:image" in re_rendering(page) or "blob:" in re_rendering(page))
    page.close()


def with_far_origin(files: Path) -> Page:
    """The result file's page with a mesh whose origin is half a metre from its middle, at the same place."""
    (page,) = open_pages(Opening(str(files / "found.jsonl"), MeshFiles((str(files / "chair.ply"),), "m")))
    (item,) = page.scene.objects
    scene = replace(page.scene, objects=(replace(item, pose=item.pose @ OFF.inverse()),))
    return replace(page, scene=scene, context=SceneContext({"": page.context.mesh("chair").moved(OFF.translation_m)}))


def test_an_object_is_fitted_wherever_its_origin_is(files: Path) -> None:
    *_, last = walk(with_far_origin(files), 0)
    found = last.pose @ OFF
    assert found.translation_m == pytest.approx(TRUE.translation_m, abs=0.006)
    assert np.degrees(Rotation.from_matrix(found.rotation.T @ TRUE.rotation).magnitude()) < 2


def test_what_is_behind_the_camera_is_not_fitted(files: Path) -> None:
    page = with_far_origin(files)
    (item,) = page.scene.objects
    behind = replace(item, pose=Pose(item.pose.rotation, item.pose.translation_m - np.array([0, 0, 2.0])))
    with pytest.raises(DataError, match="not in front of the camera"):
        next(walk(replace(page, scene=replace(page.scene, objects=(behind,))), 0))


def test_the_camera_reaches_to_the_objects_wherever_their_origins_are(files: Path) -> None:
    page = with_far_origin(files)
    assert abs(page.scene.objects[0].pose.translation_m[2] - TRUE.translation_m[2]) > 0.3
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    try:
        Space(server, lambda number, pose: None).show(page)
        assert server.scene.get_handle_by_name("/camera").scale == pytest.approx(1.5 * 0.6, rel=0.1)
    finally:
        server.stop()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    with pytest.raises(SystemExit) as exit_:
        view_command.view([str(argument) for argument in arguments])
    assert exit_.value.code in (1, 2)
    return " ".join(capsys.readouterr().err.split())


def test_bad_input_is_one_message(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.jsonl"
    other.write_text('{"name": "no result"}\n')
    assert "expected a line of curio-detect" in refused(capsys, other, "--mesh", files / "chair.ply")
    assert "there is no such file" in refused(capsys, tmp_path / "none.jsonl")
    assert "add --mesh FILE" in refused(capsys, files / "found.jsonl")
    assert "none.ply" in refused(capsys, files / "found.jsonl", "--mesh", tmp_path / "none.ply")
    assert "add --model MODEL" in refused(capsys, files / "photograph.png")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        found = refused(capsys, files / "found.jsonl", "--mesh", files / "chair.ply", "--port", port)
        assert f"cannot listen on 127.0.0.1:{port}" in found


def test_a_code_that_cannot_be_saved(files: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="choose another --out"):
        save(with_far_origin(files), tmp_path)


def test_an_object_outside_the_picture_has_no_loss(files: Path) -> None:
    page = with_far_origin(files)
    assert compare(page).shows_objects
    gone = replace(page.scene, objects=(replace(page.scene.objects[0], pose=Pose(np.eye(3), np.array([9.0, 0, 0.6]))),))
    assert not compare(replace(page, scene=gone)).shows_objects


def test_a_saved_edit_is_refused_in_another_unit(files: Path, tmp_path: Path) -> None:
    (page,) = open_pages(Opening(str(files / "found.jsonl"), MeshFiles((str(files / "chair.ply"),))))
    save(page, tmp_path / "edited.jsonl")
    with pytest.raises(DataError, match="the mesh is not the chair that was detected"):
        list(open_pages(Opening(str(tmp_path / "edited.jsonl"), MeshFiles((str(files / "chair.ply"),), "inch"))))


def test_a_scene_of_a_generated_world_is_opened_again(tmp_path: Path) -> None:
    page = next(iter(open_pages(Opening("chairs", cache=tmp_path))))
    save(page, tmp_path / "edited.jsonl")
    (again,) = open_pages(Opening(str(tmp_path / "edited.jsonl"), cache=tmp_path))
    assert again.scene.world == "chairs"
    assert again.scene.photograph is None
    for one, other in zip(again.scene.objects, page.scene.objects, strict=True):
        np.testing.assert_allclose(one.pose.translation_m, other.pose.translation_m)
        assert again.context.mesh(one.kind).diameter_m == page.context.mesh(other.kind).diameter_m
