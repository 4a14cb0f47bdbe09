"""Lines of results, and what is read back from them."""

import csv
import io
import json
from pathlib import Path

import pytest
from curio_proto.v1.detector_pb2 import Detection, RegionResult
from curio_proto.v1.model_spec_pb2 import ObjectModel
from curio_serve.batch.images.source_image import RecordedAt, SourceImage
from curio_serve.batch.results.formats import Bop, Csv, ImageResult, JsonLines
from curio_serve.batch.results.recorded_poses import Detection3DArrays, PoseRecording
from curio_serve.bop import bop_object_ids
from curio_serve.errors import OutputError, UsageError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

QUARTER_TURN = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def detection(name: str = "ape", **changes: object) -> Detection:
    values: dict[str, object] = {
        "object": name,
        "confidence": 0.9,
        "translation_m": [0.01, -0.02, 0.75],
        "rotation_6d": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0],
        "rotation": QUARTER_TURN,
        "quaternion_xyzw": [0.0, 0.0, 0.5**0.5, 0.5**0.5],
        "color": [0.1, 0.2, 0.3],
        "box_px": [float(i) for i in range(16)],
    }
    return Detection(**{**values, **changes})


def answer(image: str = "test/000002/rgb/000017.png", *found: Detection, **changes: object) -> ImageResult:
    region = RegionResult(model="ape", model_version=3, detections=found, light=[0.0, -1.0, -2.0])
    values: dict[str, object] = {
        "model": "ape",
        "version": 3,
        "width": 640,
        "height": 480,
        "camera_matrix": [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0],
        "results": [region],
        "decode_ms": 1.25,
        "inference_ms": 2.5,
    }
    return ImageResult(image, **{**values, **changes})


def test_json_line_has_the_keys_and_shapes_of_the_contract() -> None:
    line = JsonLines().encode(answer("a b.jpg", detection()))
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    record = json.loads(line)
    assert record == {
        "image": "a b.jpg",
        "width": 640,
        "height": 480,
        "camera_matrix": [[500, 0, 320], [0, 501, 240], [0, 0, 1]],
        "detections": [
            {
                "object": "ape",
                "confidence": 0.9,
                "translation_m": [0.01, -0.02, 0.75],
                "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
                "rotation_6d": [0, 1, 0, -1, 0, 0],
                "quaternion_xyzw": [0, 0, 0.5**0.5, 0.5**0.5],
                "color": [0.1, 0.2, 0.3],
                "box_px": [[2 * i, 2 * i + 1] for i in range(8)],
                "outside_trained_range": False,
            }
        ],
        "light": [0, -1, -2],
        "model": {"name": "ape", "version": 3},
        "milliseconds": {"decode": 1.25, "inference": 2.5},
    }


def test_json_error_line_has_the_error_in_place_of_the_detections() -> None:
    failed = ImageResult("bad.jpg", "ape", 3, error="not an image")
    record = json.loads(JsonLines().encode(failed))
    assert record["error"] == "not an image"
    assert "detections" not in record
    assert record["width"] is None
    assert record["model"] == {"name": "ape", "version": 3}


def test_json_has_no_nan_and_null_for_what_a_world_lacks() -> None:
    behind = detection(box_px=[float("nan")] * 2 + [1.0] * 14, color=[])
    flat = answer("x.png", behind, camera_matrix=(), results=[RegionResult(detections=[behind])])
    line = JsonLines().encode(flat)
    assert b"NaN" not in line
    record = json.loads(line)
    assert record["detections"][0]["box_px"][0] == [None, None]
    assert record["detections"][0]["color"] is None
    assert record["camera_matrix"] is None
    assert record["light"] is None


def test_frame_without_object_is_an_answer() -> None:
    record = json.loads(JsonLines().encode(answer("x.png")))
    assert record["detections"] == []
    assert "error" not in record


def test_csv_has_a_row_for_each_detection_and_one_for_an_image_without() -> None:
    form = Csv()
    text = form.header + form.encode(answer("two.png", detection(), detection("can", confidence=0.5)))
    text += form.encode(answer("none.png")) + form.encode(ImageResult("bad.png", "ape", 3, error="not an\nimage"))
    rows = list(csv.DictReader(io.StringIO(text.decode())))
    assert [(r["image"], r["detection"], r["object"]) for r in rows] == [
        ("two.png", "0", "ape"),
        ("two.png", "1", "can"),
        ("none.png", "0", ""),
        ("bad.png", "0", ""),
    ]
    assert float(rows[0]["z_m"]) == 0.75
    assert [float(rows[0][f"r{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)] == QUARTER_TURN
    assert float(rows[0]["box_v7_px"]) == 15
    assert rows[3]["error"] == "not an image"
    assert rows[3]["width"] == ""


def test_csv_says_which_positions_are_outside_of_the_trained_range() -> None:
    form, far = Csv(), detection()
    far.outside_trained_range = True
    text = form.header + form.encode(answer("two.png", detection(), far)) + form.encode(answer("none.png"))
    rows = list(csv.DictReader(io.StringIO(text.decode())))
    assert [row["outside_trained_range"] for row in rows] == ["false", "true", ""]


def test_bop_rows_are_millimetres_row_major_and_the_images_seconds() -> None:
    line = Bop({"ape": 1}).encode(answer("lmo/test/000002/rgb/000017.png", detection()))
    scene, image, obj, score, rotation, translation, seconds = line.decode().strip().split(",")
    assert (scene, image, obj) == ("2", "17", "1")
    assert float(score) == pytest.approx(0.9)
    assert [float(v) for v in rotation.split(" ")] == QUARTER_TURN
    assert [float(v) for v in translation.split(" ")] == pytest.approx([10, -20, 750])
    assert float(seconds) == pytest.approx(0.00375)


def test_bop_rows_of_several_models_have_the_time_of_the_whole_image() -> None:
    answers = [answer("lmo/test/000002/rgb/000017.png", detection(), inference_ms=ms) for ms in (2.5, 10.0)]
    rows = Bop({"ape": 1}).lines(answers).data.decode().splitlines()
    assert [float(row.rpartition(",")[2]) for row in rows] == pytest.approx([0.015, 0.015])


@pytest.mark.parametrize("image", ["000017.png", "scene/rgb/000017.png", "000002/rgb/left.png"])
def test_bop_refuses_a_path_without_scene_or_image_number(image: str) -> None:
    with pytest.raises(UsageError, match="<scene>/rgb/<image>"):
        Bop({"ape": 1}).encode(answer(image))


def test_bop_object_ids_come_from_linemod_or_the_flag() -> None:
    assert bop_object_ids(["ape", "cam"], None) == {"ape": 1, "cam": 4}  # named as curio-train names them
    assert bop_object_ids(["glue", "holepuncher"], None) == {"glue": 11, "holepuncher": 12}
    assert bop_object_ids(["gear"], 7) == {"gear": 7}
    with pytest.raises(UsageError, match=r"gear.*--obj-id"):
        bop_object_ids(["ape", "gear"], None)
    with pytest.raises(UsageError, match=r"box, cone.*--obj-id NUMBER with --objects NAME"):
        bop_object_ids(["box", "cone"], None)
    with pytest.raises(UsageError, match="2: ape, can; choose one of them with --objects"):
        bop_object_ids(["ape", "can"], 7)


@pytest.mark.parametrize("form", [JsonLines(), Csv(), Bop({"ape": 1})])
@pytest.mark.parametrize(
    "image", ["test/000002/rgb/000017.png", 'a,b/"c"/000002/rgb/17.png', "x\ny/\udcff/2/rgb/17.png"]
)
def test_a_line_names_its_image(form: JsonLines | Csv | Bop, image: str) -> None:
    (line,) = form.encode(answer(image, detection())).splitlines(keepends=True)
    assert form.parse(line).key == form.key(image)


@pytest.mark.parametrize("form", [JsonLines(), Csv()])
def test_a_line_says_its_model_and_whether_it_failed(form: JsonLines | Csv) -> None:
    good, bad = form.encode(answer("x.png", detection())), form.encode(ImageResult("y.png", "ape", 3, error="no"))
    assert form.parse(good).model == ("ape", 3)
    assert not form.parse(good).is_error
    assert form.parse(bad).is_error


@pytest.mark.parametrize("form", [JsonLines(), Csv(), Bop({"ape": 1})])
@pytest.mark.parametrize(
    "line", [b"\n", b"{}\n", b"[1]\n", b"a,b,c\n", b'{"image": "x"}\n', b"\x00\xff\n", b"1,2,9,1,R,t,0\n"]
)
def test_a_foreign_line_is_refused(form: JsonLines | Csv | Bop, line: bytes) -> None:
    with pytest.raises((ValueError, StopIteration)):
        form.parse(line)


def test_a_recording_keeps_what_one_model_found_where_another_fails() -> None:
    at = RecordedAt("/arm/image_raw", 10**9, 10**9, "arm_optical")
    failed = answer(recorded=at, results=(), error="out of memory")
    arrays = Detection3DArrays([ObjectModel(name="ape")])
    lines = arrays.lines([failed, answer("test/000002/rgb/000017.png", detection(), recorded=at)])
    assert lines.error == "out of memory"
    (found,) = json.loads(lines.data)["message"]["detections"]
    assert found["results"][0]["hypothesis"]["class_id"] == "ape"
    assert arrays.lines([failed]).data == b""


def test_an_earlier_recording_stays_until_there_is_an_image(tmp_path: Path) -> None:
    earlier, new = tmp_path / "earlier.mcap", tmp_path / "new.mcap"
    earlier.write_bytes(content := b"of an earlier run" * 1000)
    for path in (earlier, new):
        with PoseRecording(path, overwrite=True) as first:
            with pytest.raises(OutputError, match="another process is writing it"):
                PoseRecording(path, overwrite=True)
            assert list(first.unanswered(iter(()))) == []
    assert earlier.read_bytes() == content
    assert not new.exists()
    at = RecordedAt("/arm/image_raw", 10**9, 10**9, "arm_optical")
    with PoseRecording(earlier, overwrite=True) as second:
        (image,) = second.unanswered(iter([SourceImage("a", "a", recorded=at)]))
        second.write(Detection3DArrays([ObjectModel(name="ape")]).lines([answer(image.name, detection(), recorded=at)]))
    with earlier.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_summary().statistics.message_count == 1
        ((_, channel, _, message),) = reader.iter_decoded_messages()
    assert channel.topic == "/arm/detections"
    assert message.detections[0].results[0].hypothesis.class_id == "ape"
