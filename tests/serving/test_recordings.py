"""``curio-detect`` on robots' recordings: real MCAP files with ROS 2 messages, read and written."""

import json
import os
import py_compile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.batch.images import recordings
from curio_serve.batch.images.recordings import info_topic_of
from curio_serve.errors import UsageError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

IMAGE, COMPRESSED, INFO, TEXT = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "std_msgs/msg/String",
)
_HEADER = (
    f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_REGION = (
    f"{'=' * 80}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    "bool do_rectify\n"
)
DEFINITIONS = {
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data\n" + _HEADER,
    COMPRESSED: "std_msgs/Header header\nstring format\nuint8[] data\n" + _HEADER,
    INFO: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    + _HEADER
    + _REGION,
    TEXT: "string data\n",
}
WIDTH, HEIGHT = 320, 240
K = [300.0, 0.0, 161.0, 0.0, 310.0, 118.0, 0.0, 0.0, 1.0]
START_S = 1_700_000_000


@contextmanager
def recording(path: Path) -> Iterator[Callable[..., None]]:
    """``write(topic, type, number, message, frame)``: a message stamped a tenth of a second after the one before."""
    with path.open("wb") as file, Writer(file) as writer:
        schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}

        def write(topic: str, kind: str, number: int, message: dict[str, Any], frame: str = "camera_optical") -> None:
            if kind != TEXT:
                stamp = {"sec": START_S, "nanosec": number * 100_000_000}
                message = {"header": {"stamp": stamp, "frame_id": frame}, **message}
            writer.write_message(topic, schemas[kind], message, START_S * 10**9 + number * 10**8 + 5_000_000)

        yield write


def raw(pixels: np.ndarray, encoding: str = "rgb8", padding: int = 0) -> dict[str, Any]:
    height, width = pixels.shape[:2]
    shown = {"rgb8": pixels, "bgr8": pixels[..., ::-1], "mono8": pixels[..., 0]}.get(encoding, pixels)
    rows = np.pad(shown.reshape(height, -1), ((0, 0), (0, padding)))
    return {"height": height, "width": width, "encoding": encoding, "step": rows.shape[1], "data": rows.tobytes()}


def compressed(pixels: np.ndarray, suffix: str = ".png") -> dict[str, Any]:
    return {"format": suffix[1:], "data": cv2.imencode(suffix, pixels[..., ::-1])[1].tobytes()}


def info(width: int = WIDTH, height: int = HEIGHT, **changes: Any) -> dict[str, Any]:
    p = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    usual = {"width": width, "height": height, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": K, "p": p}
    return usual | {"r": np.eye(3).ravel().tolist()} | changes


@pytest.fixture
def spots(spot_image: Callable[..., np.ndarray]) -> list[np.ndarray]:
    return [spot_image(WIDTH, HEIGHT, 120 + 20 * i, 100, 15.0, 15.5, (200, 200, 200)) for i in range(4)]


def detect(model: Path, *sources: Path, **flags: Any) -> int:
    if flags.get("out") is not None:
        flags["out"] = str(flags["out"])
    return run(DetectArguments(str(model), tuple(map(str, sources)), **flags))


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("kind", ["rgb8", "bgr8", "mono8", "padded", "png"])
def test_every_kind_of_image_is_what_the_file_shows(
    kind: str, models_dir: Path, spots: list[np.ndarray], tmp_path: Path
) -> None:
    """The same pixels as PNG files with a camera file give the same poses."""
    topic = "/camera/image_raw/compressed" if kind == "png" else "/camera/image_raw"
    with recording(tmp_path / "run.mcap") as write:
        for number, pixels in enumerate(spots):
            if kind == "png":
                write(topic, COMPRESSED, number, compressed(pixels))
            else:
                write(topic, IMAGE, number, raw(pixels, "rgb8" if kind == "padded" else kind, 7 * (kind == "padded")))
            write("/camera/camera_info", INFO, number, info())
            write("/chatter", TEXT, number, {"data": "hello"})
    (tmp_path / "frames").mkdir()
    for number, pixels in enumerate(spots):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), pixels)
    (tmp_path / "camera.json").write_text(
        json.dumps({"camera_matrix": np.reshape(K, (3, 3)).tolist(), "width": WIDTH, "height": HEIGHT})
    )
    model = models_dir / "pinhole"
    assert detect(model, tmp_path / "frames", camera=tmp_path / "camera.json", out=tmp_path / "files.jsonl") == 0
    assert detect(model, tmp_path / "run.mcap", topic=topic, out=tmp_path / "run.jsonl") == 0
    found = lines(tmp_path / "run.jsonl")
    assert [line["image"] for line in found] == [
        f"{tmp_path / 'run.mcap'}#{topic}@{START_S}.{number}00000000" for number in range(4)
    ]
    assert np.ravel(found[0]["camera_matrix"]).tolist() == K
    for line, expected in zip(found, lines(tmp_path / "files.jsonl"), strict=True):
        assert line["detections"] == expected["detections"]


def test_poses_as_a_recording(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    with recording(tmp_path / "run.mcap") as write:
        for number, pixels in enumerate(spots):
            write("/arm/camera_info", INFO, number, info())
            write("/arm/image_raw", IMAGE, number, raw(pixels, "bgr8" if number != 2 else "bayer_rggb8"), "arm_optical")
    model, out = models_dir / "pinhole", tmp_path / "poses.mcap"
    assert detect(model, tmp_path / "run.mcap", out=tmp_path / "poses.jsonl") == 1
    assert detect(model, tmp_path / "run.mcap", out=out) == 1, "one image has no answer"
    with out.open("rb") as file:
        read = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [record.sequence for _, _, record, _ in read] == [1, 2, 4]
    answers = [line for line in lines(tmp_path / "poses.jsonl") if "error" not in line]
    for (schema, channel, record, message), line, number in zip(read, answers, (0, 1, 3), strict=True):
        assert schema is not None
        assert (schema.name, channel.topic) == ("vision_msgs/msg/Detection3DArray", "/arm/detections")
        assert record.log_time == START_S * 10**9 + number * 10**8 + 5_000_000
        for header in (message.header, message.detections[0].header):
            assert (header.stamp.sec, header.stamp.nanosec) == (START_S, number * 10**8)
            assert header.frame_id == "arm_optical"
        (best,) = message.detections[0].results
        expected = line["detections"][0]
        position, turn = best.pose.pose.position, best.pose.pose.orientation
        assert [position.x, position.y, position.z] == expected["translation_m"]
        assert [turn.x, turn.y, turn.z, turn.w] == expected["quaternion_xyzw"]
        assert best.hypothesis.class_id == expected["object"]
        assert best.hypothesis.score == pytest.approx(expected["confidence"], abs=1e-6)
        box = message.detections[0].bbox
        assert [box.size.x, box.size.y, box.size.z] == pytest.approx([0.1, 0.1, 0.1])
        assert box.center.position.z == pytest.approx(position.z)
    with pytest.raises(UsageError, match="--overwrite replaces it"):
        detect(model, tmp_path / "run.mcap", out=out)
    assert detect(model, tmp_path / "run.mcap", out=out, overwrite=True) == 1


def test_results_are_gone_on_with(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    with recording(tmp_path / "run.mcap") as write:
        for number, pixels in enumerate(spots):
            write("/camera/image_raw", IMAGE, number, raw(pixels))
            write("/camera/camera_info", INFO, number, info())
    out = tmp_path / "poses.jsonl"
    detect(models_dir / "pinhole", tmp_path / "run.mcap", out=out)
    whole = out.read_bytes().splitlines(keepends=True)
    out.write_bytes(b"".join(whole[:2]) + whole[2][:30])
    assert detect(models_dir / "pinhole", tmp_path / "run.mcap", out=out) == 0
    assert out.read_bytes().splitlines(keepends=True)[:2] == whole[:2]
    assert [line["image"] for line in lines(out)] == [json.loads(line)["image"] for line in whole]


def test_results_by_a_camera_file_are_not_gone_on_with_by_the_recordings_own(
    models_dir: Path, spots: list[np.ndarray], tmp_path: Path
) -> None:
    path, model, out = tmp_path / "run.mcap", models_dir / "pinhole", tmp_path / "out.jsonl"
    with recording(path) as write:
        for number in range(3):
            write("/camera/image_raw", IMAGE, number, raw(spots[number]))
            write("/camera/camera_info", INFO, number, info())
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"camera_matrix": [[900, 0, 160], [0, 900, 120], [0, 0, 1]]}))
    detect(model, path, camera=other, out=out)
    out.write_text("".join(out.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(UsageError, match="poses by another camera"):
        detect(model, path, out=out)


def test_rectified_images_have_the_matrix_of_p(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    rectified = [250.0, 0.0, 155.0, 0.0, 0.0, 250.0, 121.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    with recording(tmp_path / "run.mcap") as write:
        write("/camera/camera_info", INFO, 0, info(p=rectified, d=[0.3, 0.0, 0.0, 0.0, 0.0]))
        write("/camera/image_rect", IMAGE, 0, raw(spots[0]))
    detect(models_dir / "pinhole", tmp_path / "run.mcap", out=tmp_path / "out.jsonl")
    (line,) = lines(tmp_path / "out.jsonl")
    assert line["camera_matrix"] == [[250, 0, 155], [0, 250, 121], [0, 0, 1]]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (info(160, 120, k=[v / 2 for v in K[:6]] + K[6:]), "K belongs to frames of 160x120, this one has 320x240"),
        (info(k=[0.0] * 9), "CameraInfo: "),
        (info(distortion_model="equidistant", d=[0.1] * 4), "distortion_model is 'equidistant'"),
        (None, "no CameraInfo on /camera/camera_info has the image's stamp"),
    ],
)
def test_k_that_does_not_serve(
    message: dict[str, Any] | None, said: str, models_dir: Path, spots: list[np.ndarray], tmp_path: Path
) -> None:
    with recording(tmp_path / "run.mcap") as write:
        write("/camera/camera_info", INFO, 0 if message else 9, message or info())
        write("/camera/image_raw", IMAGE, 0, raw(spots[0]))
    assert detect(models_dir / "pinhole", tmp_path / "run.mcap", out=tmp_path / "out.jsonl") == 1
    (line,) = lines(tmp_path / "out.jsonl")
    assert said in line["error"]


def test_recordings_without_what_is_asked_for(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    path, model = tmp_path / "run.mcap", models_dir / "pinhole"
    with recording(path) as write:
        write("/left/image_raw", IMAGE, 0, raw(spots[0]))
        write("/right/image_raw", IMAGE, 0, raw(spots[0]))
        write("/right/info", INFO, 0, info())
        write("/chatter", TEXT, 0, {"data": "hello"})
    with pytest.raises(
        UsageError, match=r"has 2 topics of images; --topic .*/left/image_raw \(sensor_msgs/msg/Image\)"
    ):
        detect(model, path)
    with pytest.raises(UsageError, match=r"no topic /up/image_raw; .*/left/image_raw .*/right/image_raw .*/chatter"):
        detect(model, path, topic="/up/image_raw")
    with pytest.raises(UsageError, match="--topic /chatter holds std_msgs/msg/String"):
        detect(model, path, topic="/chatter")
    with pytest.raises(UsageError, match=r"no sensor_msgs/msg/CameraInfo on /right/camera_info.*--info-topic"):
        detect(model, path, topic="/right/image_raw")
    assert detect(model, path, topic="/right/image_raw", info_topic="/right/info", out=tmp_path / "a.jsonl") == 0
    assert detect(models_dir / "flat", path, topic="/left/image_raw", out=tmp_path / "b.jsonl") == 0, "it needs no K"
    with pytest.raises(UsageError, match="for poses in space"):
        detect(models_dir / "flat", path, topic="/left/image_raw", out=tmp_path / "c.mcap")


def test_calls_that_contradict_themselves(models_dir: Path, frames: Path, camera: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"found no \.mcap among the images"):
        detect(models_dir / "flat", frames, topic="/camera/image_raw")
    with pytest.raises(UsageError, match="images of recordings"):
        detect(models_dir / "pinhole", frames, camera=camera, out=tmp_path / "poses.mcap")


def test_damaged_recordings(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    path, model = tmp_path / "run.mcap", models_dir / "flat"
    with recording(path) as write:
        for number in range(12):
            noise = np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            write("/camera/image_raw", IMAGE, number, raw(noise))
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:-20], whole[:4], b"", b"hello" * 100):
        path.write_bytes(content)
        with pytest.raises(UsageError, match=r"run\.mcap: the recording is cut off or damaged .*mcap recover"):
            detect(model, path)
    spoilt = bytearray(whole)
    spoilt[len(whole) * 3 // 4] ^= 0xFF
    path.write_bytes(spoilt)
    assert detect(model, path, out=tmp_path / "out.jsonl") == 1
    *found, last = lines(tmp_path / "out.jsonl")
    assert 0 < len(found) < 12
    assert f"cut off or damaged after {len(found)} images" in last["error"]


def test_files_that_are_no_recordings(models_dir: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(UsageError, match="not a regular file"):
        detect(models_dir / "flat", tmp_path / "pipe.mcap")


def test_without_the_extra(models_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.mcap").touch()
    monkeypatch.setattr(recordings, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'curio-pose\[robots\]'"):
        detect(models_dir / "flat", tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/camera/image_raw", "/camera/camera_info"),
        ("/camera/image_raw/compressed", "/camera/camera_info"),
        ("/a/b/color/image_rect", "/a/b/color/camera_info"),
        ("/image", "/camera_info"),
    ],
)
def test_topics_of_camera_info_by_ros_naming(topic: str, expected: str) -> None:
    assert info_topic_of(topic) == expected


def test_the_bridge_is_python(tmp_path: Path) -> None:
    """ROS is not there to run it in."""
    source = Path(__file__).parents[2] / "examples" / "ros2" / "pose_bridge.py"
    py_compile.compile(str(source), cfile=str(tmp_path / "bridge.pyc"), doraise=True)


def test_a_glob_of_recordings_has_their_cameras(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    for name, number in (("a", 0), ("b", 1)):
        with recording(tmp_path / f"{name}.mcap") as write:
            write("/camera/image_raw", IMAGE, number, raw(spots[number]))
            write("/camera/camera_info", INFO, number, info())
    out = tmp_path / "poses.jsonl"
    assert detect(models_dir / "pinhole", tmp_path / "*.mcap", out=out, topic="/camera/image_raw") == 0
    assert [line["image"].partition("#")[0] for line in lines(out)] == [str(tmp_path / f"{n}.mcap") for n in "ab"]
    poses = tmp_path / "out" / "poses.mcap"
    assert detect(models_dir / "pinhole", tmp_path / "[ab].*", out=poses, topic="/camera/image_raw") == 0
    with poses.open("rb") as file:
        assert [channel.topic for _, channel, _ in make_reader(file).iter_messages()] == ["/camera/detections"] * 2
    cv2.imwrite(str(tmp_path / "c.png"), spots[0])
    with pytest.raises(UsageError, match="needs the intrinsics"):
        detect(models_dir / "pinhole", tmp_path / "*", out=tmp_path / "more.jsonl")
    (tmp_path / "c.mcap").write_bytes(b"torn")
    with pytest.raises(UsageError, match=r"c\.mcap"):
        detect(models_dir / "pinhole", tmp_path / "*.mcap", out=tmp_path / "more.jsonl")


def test_the_topic_of_a_rigs_recordings(models_dir: Path, spots: list[np.ndarray], tmp_path: Path) -> None:
    """Each camera's recording has two topics of images, of which --topic names one."""
    for name in ("left", "right"):
        with recording(tmp_path / f"{name}.mcap") as write:
            write("/raw", IMAGE, 0, raw(spots[0]))
            write("/small", IMAGE, 0, raw(spots[0][::2, ::2]))
    camera = {"camera_matrix": np.reshape(K, (3, 3)).tolist(), "width": WIDTH, "height": HEIGHT}
    rig = {"cameras": [camera | {"name": name, "cam_from_rig": np.eye(4).tolist()} for name in ("left", "right")]}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    sources, out = (tmp_path / "left.mcap", tmp_path / "right.mcap"), tmp_path / "poses.jsonl"
    model, given = models_dir / "pinhole", {"rig": tmp_path / "rig.json", "out": out}
    assert detect(model, *sources, **given, topic="/raw") == 0
    (line,) = lines(out)
    assert [view.partition("@")[0] for view in line["views"]] == [f"{source}#/raw" for source in sources]
    with pytest.raises(UsageError, match="--topic names the one to read"):
        detect(model, *sources, **given)
    with pytest.raises(UsageError, match=r"no \.mcap among the images"):
        detect(model, tmp_path, tmp_path, **given, topic="/raw")
