"""Faults planted one by one in files that are good: each is found by its name, and nothing is found without it."""

import functools
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from curio_train.camera import load_intrinsics
from curio_train.data.photographs import FEWEST_TO_LEARN_FROM, NUM_JUDGED
from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.finding import Finding
from curio_train.worlds.base import Camera
from curio_train.worlds.capture import CapturePhotographs
from PIL import Image

WIDTH, HEIGHT, NUM_PHOTOS = 160, 120, 84
K = [[180.0, 0.0, 81.0], [0.0, 180.0, 58.0], [0.0, 0.0, 1.0]]


@functools.cache
def plate() -> np.ndarray:
    """An empty scene in RGB: a warm table of fine grain, a cupboard behind it."""
    random = np.random.default_rng(0)
    scene = np.full((HEIGHT, WIDTH, 3), (170, 130, 80), np.float64)
    scene[:45] = (90, 110, 120)
    scene[20:45, 30:60] = (200, 190, 170)
    return (scene + random.normal(0, 10, (HEIGHT, WIDTH, 1))).clip(0, 255).astype(np.uint8)


@functools.cache
def photo(number: int) -> np.ndarray:
    """The scene with a box somewhere on it."""
    random = np.random.default_rng(number + 1)
    image = plate().copy()
    left, top = int(random.integers(0, WIDTH - 40)), int(random.integers(0, HEIGHT - 40))
    image[top : top + 32, left : left + 36] = random.integers(40, 220, (1, 1, 3))
    return (image + random.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)


def save(path: Path, image: np.ndarray) -> None:
    cv2.imwrite(str(path), image[..., ::-1])


@dataclass
class Files:
    """Good files in a folder, for a test to spoil one of."""

    folder: Path

    @property
    def mesh(self) -> Path:
        return self.folder / "part.ply"

    @property
    def camera(self) -> Path:
        return self.folder / "camera.json"

    @property
    def photos(self) -> list[Path]:
        return sorted((self.folder / "photos").iterdir())

    @property
    def plate(self) -> Path:
        return self.folder / "plate.png"

    def subjects(self) -> Subjects:
        return Subjects(
            mesh=self.mesh,
            mesh_unit="mm",
            camera=self.camera,
            photos=self.folder / "photos",
            background=self.plate,
        )


def write_camera(path: Path, matrix: Sequence[Sequence[float]] = K, **other: object) -> None:
    content = {"camera_matrix": matrix, "width": WIDTH, "height": HEIGHT}
    path.write_text(json.dumps(content | other))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files before any test spoils them."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "photos").mkdir()
    for number in range(NUM_PHOTOS):
        save(folder / "photos" / f"{number:03}.png", photo(number))
    found = Files(folder)
    solid = trimesh.creation.box((40, 60, 90))
    solid.visual.vertex_colors = np.tile([200, 150, 40, 255], (8, 1)).astype(np.uint8)
    solid.export(found.mesh)
    write_camera(found.camera)
    save(found.plate, plate())
    return folder


@pytest.fixture
def files(good: Path, tmp_path: Path) -> Files:
    return Files(Path(shutil.copytree(good, tmp_path, dirs_exist_ok=True)))


def alarms(subjects: Subjects) -> list[Finding]:
    return [finding for finding in examine_files(subjects) if finding.state != "good"]


def test_good_files_raise_no_alarm(files: Files) -> None:
    assert alarms(files.subjects()) == []


# Faults of the camera file.


@pytest.mark.parametrize(
    ("matrix", "other", "fault"),
    [
        pytest.param([[180, 0, 58], [0, 180, 81], [0, 0, 1]], {}, "swapped centre", id="cx and cy"),
        pytest.param(np.transpose(K).tolist(), {}, "transposed matrix", id="transposed"),
        pytest.param([[360, 0, 162], [0, 360, 116], [0, 0, 1]], {}, "other resolution", id="of twice the size"),
        pytest.param([[90, 0, 40], [0, 90, 29], [0, 0, 1]], {}, "other resolution", id="of half the size"),
        pytest.param([[180, 0, 81], [0, 240, 58], [0, 0, 1]], {}, "focal length", id="squeezed pixels"),
        pytest.param([[35, 0, 81], [0, 35, 58], [0, 0, 1]], {}, "focal length", id="in millimetres"),
        pytest.param(K, {"distortion": [-1.9, 0.3, 0, 0, 0]}, "camera unreadable", id="folding distortion"),
        pytest.param([[0, 0, 81], [0, 180, 58], [0, 0, 1]], {}, "focal length", id="singular"),
        pytest.param([[180, 0, 130], [0, 180, 58], [0, 0, 1]], {}, "odd centre", id="of a cut-out"),
    ],
)
def test_faults_of_the_camera_file(
    files: Files, matrix: list[list[float]], other: dict[str, object], fault: str
) -> None:
    write_camera(files.camera, matrix, **other)
    assert fault in {finding.fault for finding in alarms(Subjects(camera=files.camera))}


def test_a_camera_of_other_photographs(files: Files) -> None:
    write_camera(files.camera, [[360, 0, 162.5], [0, 360, 116.5], [0, 0, 1]], width=2 * WIDTH, height=2 * HEIGHT)
    (finding,) = alarms(replace(files.subjects(), mesh=None, background=None))
    assert finding.fault == "other size"
    assert "Scale K by 0.5" in finding.remedy


def test_photographs_turned_by_a_quarter(files: Files) -> None:
    for path in files.photos:
        save(path, np.rot90(photo(int(path.stem))).copy())
    (finding,) = alarms(replace(files.subjects(), mesh=None, background=None))
    assert finding.fault == "turned"


# Faults of photographs.


def test_exif_rotation_and_focal_length(files: Files) -> None:
    for path in files.photos:
        exif = Image.Exif()
        exif[0x0112] = 6
        exif.get_ifd(0x8769)[0xA405] = 85
        Image.fromarray(photo(int(path.stem))).save(path.with_suffix(".jpg"), exif=exif, quality=95)
        path.unlink()
    found = {finding.fault: finding for finding in alarms(replace(files.subjects(), background=None))}
    assert found.keys() == {"EXIF rotation", "focal length"}
    assert "85 mm" in found["focal length"].text


def test_broken_exif_entries_say_nothing(files: Files) -> None:
    for number, broken in enumerate((b"garbage", b"II", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\0")):
        for suffix, options in ((".png", {}), (".webp", {"lossless": True})):
            path = files.photos[2 * number + (suffix == ".webp")]
            image = Image.fromarray(photo(int(path.stem)))
            path.unlink()
            image.save(path.with_suffix(suffix), exif=b"Exif\0\0" + broken, **options)
    assert alarms(files.subjects()) == []


def test_duplicates(files: Files) -> None:
    cv2.imwrite(str(files.photos[0].with_name("copy.png")), cv2.imread(str(files.photos[0])))
    (finding,) = alarms(files.subjects())
    assert finding.fault == "duplicates"
    assert "000.png and copy.png" in finding.text


def test_blurred(files: Files) -> None:
    for path in files.photos[:20]:
        save(path, cv2.GaussianBlur(photo(int(path.stem)), (0, 0), 4))
    (finding,) = alarms(files.subjects())
    assert finding.fault == "blurred"
    assert "20 of 84" in finding.text


def test_exposure(files: Files) -> None:
    for path in files.photos[:20]:
        save(path, (photo(int(path.stem)).astype(float) * 3).clip(0, 255).astype(np.uint8))
    assert "exposure" in {finding.fault for finding in alarms(files.subjects())}


def test_twelve_bits_in_files_of_sixteen(files: Files) -> None:
    for path in files.photos[:20]:
        twelve_bits = photo(int(path.stem)).astype(np.uint16) * 16
        twelve_bits[0, 0] = 4095  # saturated
        save(path, twelve_bits)
    (finding,) = alarms(files.subjects())
    assert finding.fault == "dark"
    assert "20 of 84" in finding.text


def test_too_few_to_learn_from(files: Files) -> None:
    """The number at which the doctor warns is the one at which training stops learning from photographs."""
    for path in files.photos[FEWEST_TO_LEARN_FROM - 1 :]:
        path.unlink()
    (finding,) = alarms(files.subjects())
    assert (finding.fault, finding.state) == ("too few", "warning")
    assert f"only {FEWEST_TO_LEARN_FROM - 1}; below {FEWEST_TO_LEARN_FROM}" in finding.text
    split = CapturePhotographs(files.folder / "photos", None, load_intrinsics(files.camera), Camera(WIDTH, HEIGHT))
    assert split.unlabelled().paths == []
    save(files.folder / "photos" / "one_more.png", photo(1000))
    assert alarms(files.subjects()) == []
    assert len(split.unlabelled().paths) == FEWEST_TO_LEARN_FROM - NUM_JUDGED


def test_the_background_image_among_the_photographs_is_none_of_them(files: Files) -> None:
    among = files.folder / "photos" / "background.png"
    files.plate.rename(among)
    subjects = replace(files.subjects(), background=among)
    assert alarms(subjects) == []
    (told,) = (found.text for found in examine_files(subjects) if found.subject == "photographs")
    assert told.endswith(f"84 of {WIDTH}x{HEIGHT}, not counting background.png, the empty scene")
    for path in files.photos[FEWEST_TO_LEARN_FROM - 1 : NUM_PHOTOS]:
        path.unlink()
    (finding,) = alarms(subjects)
    assert finding.text.startswith(f"only {FEWEST_TO_LEARN_FROM - 1}, not counting background.png, the")


def test_mixed_sizes(files: Files) -> None:
    save(files.photos[3], photo(3)[:100])
    assert [finding.fault for finding in alarms(Subjects(photos=files.folder / "photos"))] == ["mixed sizes"]


def test_unreadable_photographs(files: Files) -> None:
    files.photos[5].write_bytes(b"\x89PNG")
    (finding,) = alarms(files.subjects())
    assert (finding.fault, finding.state) == ("photographs unreadable", "bad")
    assert "005.png" in finding.text
    for path in files.photos[6:12]:
        path.write_bytes(b"\x89PNG")
    finding, *_ = alarms(files.subjects())  # of so few there are others
    assert finding.text.startswith("7 of ")
    assert all(f"{number:03}.png" in finding.text for number in range(5, 10))
    assert finding.text.endswith("; and 2 more")


def test_hidden_files_are_no_photographs(files: Files) -> None:
    (files.folder / "photos" / "._000.png").write_bytes(b"\x00\x05\x16\x07")
    assert alarms(files.subjects()) == []


def test_some_raw_frames_saved_as_bgr(files: Files) -> None:
    for path in files.photos[::6]:
        cv2.imwrite(str(path), photo(int(path.stem)))
    (finding,) = alarms(replace(files.subjects(), background=None))
    assert finding.fault == "swapped colours"
    assert "14 of 84" in finding.text


# Faults of the background image.


def other_scene() -> np.ndarray:
    return np.ascontiguousarray(255 - plate()[::-1])


def brighter() -> np.ndarray:
    return (plate() * 1.35).clip(0, 255).astype(np.uint8)


def shifted() -> np.ndarray:
    return np.ascontiguousarray(np.roll(plate(), (20, 25), axis=(0, 1)))


def as_bgr() -> np.ndarray:
    return np.ascontiguousarray(plate()[..., ::-1])


@pytest.mark.parametrize(
    ("spoilt", "fault"),
    [
        (other_scene, "other background"),
        (brighter, "background exposure"),
        (shifted, "background shifted"),
        (as_bgr, "swapped colours"),
        (lambda: plate()[:, :100], "background size"),
    ],
)
def test_faults_of_the_plate(files: Files, spoilt: Callable[[], np.ndarray], fault: str) -> None:
    save(files.plate, spoilt())
    (finding,) = alarms(files.subjects())
    assert finding.fault == fault


def test_a_plate_of_another_size_than_the_camera(files: Files) -> None:
    subjects = Subjects(camera=files.camera, background=files.plate)
    assert alarms(subjects) == []
    save(files.plate, plate()[:, :100])
    (finding,) = alarms(subjects)
    assert (finding.fault, finding.state) == ("background size", "bad")
    assert f"has 100x{HEIGHT} pixels, the camera file is for {WIDTH}x{HEIGHT}" in finding.text


@pytest.mark.parametrize("name", ["mesh", "camera", "photos", "background", "model"])
def test_missing_files(tmp_path: Path, name: str) -> None:
    path = tmp_path / "missing.ply"
    (finding,) = alarms(Subjects(**{name: path}))
    assert finding.state == "bad"
    assert "missing.ply" in finding.text


@pytest.mark.skipif("CURIO_DATA" not in os.environ, reason="CURIO_DATA names no folder with LM-O")
def test_no_alarm_on_camera_and_frames_of_lmo() -> None:
    root = Path(os.environ["CURIO_DATA"]) / "lmo"
    frames = next((root / "test").glob("*/rgb"))
    assert alarms(Subjects(camera=root / "camera.json", photos=frames)) == []
