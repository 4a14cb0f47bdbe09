"""Image files: what is converted, what is refused."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.data.photographs import Photographs, read_photograph
from curio_train.errors import DataError
from PIL import Image

PIXELS = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)


def save(path: Path, pixels: np.ndarray, mode: str | None = None, **options: object) -> Path:
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


def test_photographs_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("a10.png", "a9.png", "a1.png"):
        save(tmp_path / name, PIXELS)
    assert [path.name for path in Photographs(tmp_path).paths] == ["a1.png", "a9.png", "a10.png"]


@pytest.mark.parametrize(("suffix", "is_read"), [(".png", True), (".jpg", True), (".tiff", False)])
def test_a_rotation_that_cannot_be_ignored_is_refused(tmp_path: Path, suffix: str, is_read: bool) -> None:
    file, stored, exif = tmp_path / f"a{suffix}", np.zeros((48, 64, 3), np.uint8), Image.Exif()
    stored[:16, :16] = 255
    exif[0x0112] = 3
    Image.fromarray(stored).save(file, exif=exif)
    if is_read:
        assert read_photograph(file)[4, 4, 0] > 200
    else:
        with pytest.raises(DataError, match="a TIFF file with an EXIF rotation"):
            read_photograph(file)


def test_transparent_pixels_are_read_beneath_or_refused(tmp_path: Path) -> None:
    pixels = np.full((4, 4, 4), (200, 100, 10, 0), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert read_photograph(tmp_path / "a.png")[0, 0].tolist() == [200, 100, 10]
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    with pytest.raises(DataError, match="has transparent pixels"):
        read_photograph(tmp_path / "a.tif")


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff"])
def test_rgb(tmp_path: Path, suffix: str) -> None:
    assert np.array_equal(read_photograph(save(tmp_path / f"a{suffix}", PIXELS)), PIXELS)


def test_grey(tmp_path: Path) -> None:
    found = read_photograph(save(tmp_path / "a.png", PIXELS[..., 0]))
    assert np.array_equal(found, np.repeat(PIXELS[..., :1], 3, axis=2))


def test_alpha_is_dropped(tmp_path: Path) -> None:
    rgba = np.concatenate([PIXELS, np.zeros((6, 8, 1), dtype=np.uint8)], axis=2)
    assert np.array_equal(read_photograph(save(tmp_path / "a.png", rgba)), PIXELS)


def test_palette(tmp_path: Path) -> None:
    flat = np.tile(np.uint8([204, 51, 102]), (6, 8, 1))
    assert np.array_equal(read_photograph(save(tmp_path / "a.png", flat, "P")), flat)


def test_sixteen_bits(tmp_path: Path) -> None:
    deep = PIXELS.astype(np.uint16) * 257
    assert cv2.imwrite(str(tmp_path / "a.png"), deep[..., ::-1])
    assert np.array_equal(read_photograph(tmp_path / "a.png"), PIXELS)


def test_cmyk(tmp_path: Path) -> None:
    flat = np.tile(np.uint8([200, 30, 90]), (16, 16, 1))
    found = read_photograph(save(tmp_path / "a.jpg", flat, "CMYK", quality=98)).astype(int)
    assert found.shape == (16, 16, 3)
    assert np.abs(found - [200, 30, 90]).max() < 12


def test_exif_rotation_is_ignored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees
    path = save(tmp_path / "a.jpg", PIXELS, exif=exif)
    assert read_photograph(path).shape == PIXELS.shape


def test_one_pixel(tmp_path: Path) -> None:
    assert read_photograph(save(tmp_path / "a.png", PIXELS[:1, :1])).shape == (1, 1, 3)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9])
def test_truncated(tmp_path: Path, suffix: str, kept: float) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    path = save(tmp_path / f"a{suffix}", noise)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(DataError, match="not a complete image") as caught:
        read_photograph(path)
    assert str(path) in str(caught.value)


def test_refuses(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_photograph(tmp_path / "none.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(DataError, match="0 bytes"):
        read_photograph(tmp_path / "empty.png")
    (tmp_path / "text.jpg").write_text("not an image at all")
    with pytest.raises(DataError, match="not a complete image"):
        read_photograph(tmp_path / "text.jpg")
    Image.new("1", (9000, 9000)).save(tmp_path / "vast.png")
    with pytest.raises(DataError, match="9000x9000 pixels, expected at most"):
        read_photograph(tmp_path / "vast.png")


def test_folders(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        Photographs(tmp_path / "none")
    (tmp_path / "note.txt").touch()
    with pytest.raises(DataError, match="no such folder"):
        Photographs(tmp_path / "note.txt")
    with pytest.raises(DataError, match=r"a: cannot be listed \(File name too long\)"):
        Photographs(tmp_path / ("a" * 300))
    with pytest.raises(DataError, match="found no images"):
        Photographs(tmp_path)
    save(tmp_path / "b.png", PIXELS)
    save(tmp_path / "a.JPG", PIXELS)
    assert [path.name for path in Photographs(tmp_path).paths] == ["a.JPG", "b.png"]


def test_the_image_of_the_empty_scene_is_no_photograph(tmp_path: Path) -> None:
    photos, empty = tmp_path / "photos", tmp_path / "photos" / "empty.png"
    photos.mkdir()
    save(empty, PIXELS)
    with pytest.raises(DataError, match=r"found no images, not counting empty\.png, the empty scene"):
        Photographs(photos, [empty])
    save(photos / "a.png", PIXELS)
    save(tmp_path / "a.png", PIXELS)
    (tmp_path / "link").symlink_to(photos)
    by_another_path = tmp_path / "link" / ".." / "photos" / "empty.png"
    found = Photographs(photos, [tmp_path / "a.png", by_another_path])
    assert [path.name for path in found.paths] == ["a.png"]
    assert found.note == ", not counting empty.png, the empty scene"
    assert Photographs(photos, [tmp_path / "a.png"]).note == ""


@pytest.mark.parametrize("size", [(4, 4), (8, 6), (64, 16), (16, 64), (1, 1)])
def test_crops(tmp_path: Path, size: tuple[int, int]) -> None:
    save(tmp_path / "a.png", PIXELS)
    photographs = Photographs(tmp_path)
    crops = [photographs.random_crop(*size, np.random.default_rng(seed)) for seed in range(30)]
    assert all(crop.shape == (size[1], size[0], 3) and crop.dtype == np.uint8 for crop in crops)
    assert len({crop.tobytes() for crop in crops}) > 5
    again = photographs.random_crop(*size, np.random.default_rng(7))
    assert np.array_equal(again, crops[7])


def test_crop_keeps_the_shape_of_things(tmp_path: Path) -> None:
    # Grey rises along x by 1 a pixel: in a crop twice as small it must rise by 2 * scale, in both directions alike.
    y, x = np.mgrid[0:120, 0:200]
    save(tmp_path / "a.png", np.stack([x, y, 0 * x], axis=-1).astype(np.uint8))
    crop = Photographs(tmp_path).random_crop(40, 30, np.random.default_rng(0)).astype(float)
    along_x = abs(crop[15, 35, 0] - crop[15, 5, 0]) / 30
    along_y = (crop[25, 20, 1] - crop[5, 20, 1]) / 20
    assert along_x == pytest.approx(along_y, rel=0.06)
    assert 1.9 < along_x < 4.1


def test_real_photographs() -> None:
    root = os.environ.get("CURIO_DATA")
    if not root:
        pytest.skip("CURIO_DATA is not set: no real photographs to read")
    photographs = Photographs(Path(root) / "backgrounds")
    assert len(photographs) == 124
    assert all(read_photograph(path).ndim == 3 for path in photographs.paths)
