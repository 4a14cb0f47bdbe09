"""Bytes to pixels: what is accepted, what is refused and with which words, before anything is decoded."""

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from curio_serve.errors import ImageError
from curio_serve.imaging.image import decode, from_raw
from curio_serve.imaging.image_header import read_header
from curio_serve.imaging.png import pixels_only

FORMATS = {".jpg": "jpeg", ".png": "png", ".webp": "webp"}


def _scene(width: int = 64, height: int = 48, seed: int = 0) -> np.ndarray:
    """Smooth random colours, uint8 RGB."""
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3)).astype(np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def _encode(rgb: np.ndarray, suffix: str, *parameters: int) -> bytes:
    stored = rgb[..., ::-1] if rgb.ndim == 3 and rgb.shape[2] == 3 else rgb
    return cv2.imencode(suffix, stored, parameters)[1].tobytes()


def _with_exif(jpeg: bytes, orientation: int, order: str = "<") -> bytes:
    tiff = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}HIH", 42, 8, 1)
    tiff += struct.pack(f"{order}HHIHHI", 0x0112, 3, 1, orientation, 0, 0)
    body = b"Exif\x00\x00" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def _png(width: int, height: int, depth: int, color_type: int, rows: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", FORMATS)
def test_good_images_come_back(suffix: str) -> None:
    scene = _scene()
    data = _encode(scene, suffix, *((cv2.IMWRITE_WEBP_QUALITY, 101) if suffix == ".webp" else ()))
    header = read_header(data)
    assert (header.format, header.width, header.height) == (FORMATS[suffix], 64, 48)
    frame = decode(data)
    assert (frame.width, frame.height, frame.reduction) == (64, 48, 1)
    assert np.abs(frame.pixels.astype(int) - scene).mean() < (6 if suffix == ".jpg" else 0.5)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
def test_truncated_images_are_refused(suffix: str, share: float) -> None:
    data = _encode(_scene(320, 240), suffix)
    with pytest.raises(ImageError):
        decode(data[: int(len(data) * share)])


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_larger_than_its_data(progressive: int) -> None:
    jpeg = _encode(_scene(640, 480), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    marker = jpeg.index(b"\xff\xc2" if progressive else b"\xff\xc0")
    larger = jpeg[: marker + 5] + struct.pack(">HH", 5792, 5792) + jpeg[marker + 9 :]
    with pytest.raises(ImageError, match=r"declares 5792x5792 pixels, which take at least \d+ bytes"):
        decode(larger)


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_jpeg_of_one_color_has_bytes_enough(progressive: int, channels: int) -> None:
    flat = np.full((2048, 2048, channels), 128, np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_QUALITY, 1]
    assert decode(cv2.imencode(".jpg", flat, options)[1].tobytes()).width == 2048


def test_a_png_whose_checksum_does_not_fit_is_refused_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    damaged = bytearray(_encode(_scene(), ".png"))
    damaged[len(damaged) // 2] ^= 8
    with pytest.raises(ImageError, match="a checksum does not fit"):
        decode(bytes(damaged))
    assert capfd.readouterr() == ("", "")


def test_an_animated_png_is_no_picture() -> None:
    still = _encode(_scene(), ".png")
    with pytest.raises(ImageError, match="the PNG is an animation"):
        decode(still[:33] + struct.pack(">I", 8) + b"acTL" + bytes(12) + still[33:])


def test_a_thumbnails_end_is_not_the_pictures_end() -> None:
    jpeg = _encode(_scene(320, 240), ".jpg")
    body = b"Exif\x00\x00" + _encode(_scene(32, 24), ".jpg")
    whole = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]
    assert decode(whole).width == 320
    with pytest.raises(ImageError, match="cut short"):
        decode(whole[:-200])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"GIF89a" + bytes(100), "not a JPEG, PNG or WebP"),
        (
            bytes.fromhex("00000024") + b"ftypheic" + bytes(100),
            "HEIC picture, .*: convert it, for example by heif-convert",
        ),
        (b"hello world, this is text", "not a JPEG, PNG or WebP"),
        (b"\xff\xd8\xff", "ends inside its header"),
        (b"\xff\xd8\xff\xd9", "no picture data"),
        (b"\x89PNG\r\n\x1a\n", "ends inside its header"),
        (b"RIFF\x10\x00\x00\x00WEBPVP8 ", "cut short"),
        (b"RIFF\x04\x00\x00\x00WEBP", "ends inside its header|first chunk"),
    ],
)
def test_what_is_no_image_is_named(data: bytes, words: str) -> None:
    with pytest.raises(ImageError, match=words):
        decode(data)


def test_a_small_file_of_a_huge_picture_is_refused_before_it_is_decoded() -> None:
    side = 12_000
    data = _png(side, side, 8, 0, bytes((side + 1) * side))
    assert len(data) < 200_000
    tracemalloc.start()
    try:
        with pytest.raises(ImageError, match="12000x12000 = 144000000 pixels"):
            decode(data)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("size", [(1, 1), (15, 200), (200, 15)])
def test_tiny_images_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match=f"{size[0]}x{size[1]} pixels; each side needs at least 16"):
        decode(_encode(_scene(*size), ".png"))


def test_grey_becomes_three_equal_channels() -> None:
    grey = cv2.cvtColor(_scene(), cv2.COLOR_RGB2GRAY)
    for suffix in FORMATS:
        pixels = decode(_encode(grey, suffix)).pixels
        assert pixels.shape == (48, 64, 3)
        assert np.ptp(pixels.astype(int), axis=2).max() <= (8 if suffix == ".webp" else 0)


def test_sixteen_bits_lose_their_low_byte() -> None:
    values = (np.arange(64 * 48).reshape(48, 64) * 21).astype(np.uint16)
    rows = b"".join(b"\x00" + row.astype(">u2").tobytes() for row in values)
    pixels = decode(_png(64, 48, 16, 0, rows)).pixels
    assert np.abs(pixels[..., 0].astype(int) - (values >> 8)).max() <= 1


def test_alpha_is_dropped_and_colours_stay_as_stored() -> None:
    scene = _scene()
    alpha = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    rgba = np.dstack([scene, alpha])
    rows = b"".join(b"\x00" + row.tobytes() for row in rgba)
    np.testing.assert_array_equal(decode(_png(64, 48, 8, 6, rows)).pixels, scene)


def test_cmyk_is_refused() -> None:
    jpeg = bytearray(_encode(_scene(), ".jpg"))
    frame_header = jpeg.find(b"\xff\xc0")
    # Four components instead of three, as a CMYK file declares them.
    length = struct.unpack_from(">H", jpeg, frame_header + 2)[0]
    jpeg[frame_header + 9] = 4
    jpeg[frame_header + 2 : frame_header + 4] = struct.pack(">H", length + 3)
    jpeg[frame_header + 2 + length : frame_header + 2 + length] = b"\x04\x11\x00"
    with pytest.raises(ImageError, match="CMYK"):
        decode(bytes(jpeg))


def test_many_scans_are_refused() -> None:
    jpeg = _encode(_scene(), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    assert decode(jpeg).width == 64
    scan = jpeg[jpeg.rfind(b"\xff\xda") : -2]
    with pytest.raises(ImageError, match="scans; at most 64"):
        decode(jpeg[:-2] + scan * 100 + b"\xff\xd9")


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_rotation_is_ignored_unless_asked_for(order: str) -> None:
    jpeg = _encode(_scene(), ".jpg")
    stored = decode(jpeg).pixels
    for orientation, turns in ((1, 0), (6, 1), (3, 2), (8, 3)):
        turned = _with_exif(jpeg, orientation, order)
        assert read_header(turned).orientation == orientation
        np.testing.assert_array_equal(decode(turned).pixels, stored)
        frame = decode(turned, apply_exif_rotation=True)
        assert frame.quarter_turns == turns
        np.testing.assert_array_equal(frame.pixels, np.rot90(stored, -turns))
        assert (frame.width, frame.height) == ((48, 64) if turns % 2 else (64, 48))


def test_mirrored_exif_is_refused_when_asked_for() -> None:
    mirrored = _with_exif(_encode(_scene(), ".jpg"), 2)
    assert decode(mirrored).width == 64
    with pytest.raises(ImageError, match="orientation 2 mirrors"):
        decode(mirrored, apply_exif_rotation=True)


@pytest.mark.parametrize("max_reduction", [1, 2, 4, 8])
def test_reduced_decoding_shows_the_same_scene(max_reduction: int) -> None:
    scene = _scene(640, 480)
    frame = decode(_encode(scene, ".jpg"), max_reduction=max_reduction)
    assert frame.reduction == max_reduction
    assert (frame.width, frame.height) == (640, 480)
    expected = cv2.resize(scene, frame.pixels.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(frame.pixels.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    "options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)]
)
@pytest.mark.parametrize("is_grey", [False, True])
def test_jpegs_are_decoded_as_opencv_does(options: tuple[int, ...], is_grey: bool) -> None:
    """Models were trained on its pixels."""
    scene = _scene(320, 240)
    data = _encode(scene[..., 0] if is_grey else scene, ".jpg", *options)
    for reduction, flag in ((1, cv2.IMREAD_COLOR), (2, cv2.IMREAD_REDUCED_COLOR_2), (8, cv2.IMREAD_REDUCED_COLOR_8)):
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), flag)[..., ::-1]
        assert np.array_equal(decode(data, max_reduction=reduction).pixels, expected)


@pytest.mark.parametrize("damage", ["removed", "zeros", "end in the middle", "cut"])
def test_a_jpeg_that_is_damaged_inside_is_refused_and_nothing_is_printed(
    damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    data = _encode(np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8), ".jpg")
    middle = len(data) // 2
    damaged = {
        "removed": data[:middle] + data[middle + 500 :],
        "zeros": data[:middle] + bytes(400) + data[middle + 400 :],
        "end in the middle": data[:middle] + b"\xff\xd9" + data[middle:],
        "cut": data[:middle] + b"\xff\xd9",
    }[damage]
    with pytest.raises(ImageError, match=r"the JPEG is damaged \(Corrupt JPEG data: "):
        decode(damaged)
    assert capfd.readouterr() == ("", "")


def test_what_cameras_leave_in_jpegs_is_passed_over() -> None:
    """A few bytes before the end, and what follows it."""
    data = _encode(_scene(320, 240), ".jpg")
    for odd in (data[:-2] + bytes(6) + data[-2:], data + b"some more"):
        assert np.array_equal(decode(odd).pixels, decode(data).pixels)
    with pytest.raises(ImageError, match="extraneous bytes before marker 0xd9"):
        decode(data[:-2] + bytes(40) + data[-2:])


def test_reduction_is_used_only_where_it_is_exact() -> None:
    assert decode(_encode(_scene(644, 484), ".jpg"), max_reduction=8).reduction == 4
    assert decode(_encode(_scene(641, 480), ".jpg"), max_reduction=8).reduction == 1
    assert decode(_encode(_scene(640, 480), ".png"), max_reduction=8).reduction == 1


@pytest.mark.parametrize("suffix", FORMATS)
def test_damaged_images_never_show_another_images_pixels(suffix: str) -> None:
    """What a damaged file decodes to (or is refused as) must not depend on what was decoded before."""
    good = [_encode(_scene(320, 240, seed), suffix) for seed in (1, 2)]
    victim = _encode(_scene(320, 240, 3), suffix)
    random = np.random.default_rng(0)

    def outcome(data: bytes) -> bytes:
        try:
            return decode(data).pixels.tobytes()
        except ImageError:
            return b"refused"

    for _ in range(40):
        damaged = bytearray(victim)
        for position in random.integers(len(victim) // 10, len(victim), 8):
            damaged[position] ^= 1 << int(random.integers(8))
        seen = []
        for before in good:
            decode(before)
            seen.append(outcome(bytes(damaged)))
        assert seen[0] == seen[1]


def test_raw_pixels_in_all_orders_and_strides() -> None:
    scene = _scene()
    height, width, _ = scene.shape
    padded = np.zeros((height, width * 3 + 13), np.uint8)
    padded[:, : width * 3] = scene.reshape(height, -1)
    for data in (padded.tobytes(), padded.tobytes()[:-13]):
        np.testing.assert_array_equal(from_raw(data, "RGB8", width, height, width * 3 + 13).pixels, scene)
    np.testing.assert_array_equal(from_raw(scene.tobytes(), "RGB8", width, height).pixels, scene)
    np.testing.assert_array_equal(from_raw(scene[..., ::-1].tobytes(), "BGR8", width, height).pixels, scene)
    grey = np.ascontiguousarray(scene[..., 0])
    np.testing.assert_array_equal(from_raw(grey.tobytes(), "GRAY8", width, height).pixels, np.dstack([grey] * 3))


@pytest.mark.parametrize(
    ("num_bytes", "width", "height", "stride", "words"),
    [
        (64 * 48 * 3 - 1, 64, 48, 0, "takes 9216"),
        (64 * 48 * 3, 64, 48, 100, "shorter than a row of 192"),
        (0, 64, 48, 0, "0 bytes"),
        (12, 2, 2, 0, "2x2 pixels"),
        (100, 1 << 20, 1 << 20, 0, "at most 33554432"),
    ],
)
def test_raw_sizes_that_do_not_fit_are_refused(
    num_bytes: int, width: int, height: int, stride: int, words: str
) -> None:
    with pytest.raises(ImageError, match=words):
        from_raw(bytes(num_bytes), "RGB8", width, height, stride)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _zeros(num_mebibytes: int) -> bytes:
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(num_mebibytes)) + packer.flush()


def test_text_in_a_png_is_dropped_before_decoding() -> None:
    plain = _encode(_scene(), ".png")
    text = b"".join(_chunk(b"zTXt", b"a\0\0" + _zeros(16)) for _ in range(3))
    loaded = plain[:33] + text + plain[33:]
    kept = pixels_only(loaded)
    assert text not in kept
    np.testing.assert_array_equal(decode(loaded).pixels, decode(plain).pixels)
    assert pixels_only(plain) is plain


def test_image_data_beyond_the_last_row_is_refused() -> None:
    head = b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 48, 8, 2, 0, 0, 0))
    packed = _zeros(128)
    halves = _chunk(b"IDAT", packed[:50_000]) + _chunk(b"IDAT", packed[50_000:])
    with pytest.raises(ImageError, match=r"more image data than .* expected 9264; save it again"):
        decode(head + halves + _chunk(b"IEND", b""))


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_large_pngs_of_noise_are_read(depth: type) -> None:
    noise = np.random.default_rng(0).integers(0, np.iinfo(depth).max, (300, 400, 3)).astype(depth)
    assert decode(_encode(noise, ".png")).pixels.shape == (300, 400, 3)
