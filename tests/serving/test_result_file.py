"""A result file that is written, killed, read back and gone on with."""

import fcntl
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from curio_proto.v1.detector_pb2 import Detection, RegionResult
from curio_serve.batch.results.formats import Bop, Csv, ImageResult, JsonLines, ResultFormat
from curio_serve.batch.results.result_file import ResultFile
from curio_serve.errors import OutputError, UsageError

MODEL = ("ape", 1)
FORMATS = [JsonLines(), Csv(), Bop({"ape": 1})]


@dataclass(frozen=True)
class Image:
    name: str


IMAGES = [Image(f"000001/rgb/{number:06d}.png") for number in range(6)]


def result(image: Image, model: tuple[str, int] = MODEL) -> ImageResult:
    """Image n has n % 3 detections; number 5 cannot be read."""
    number = int(Path(image.name).stem)
    if number == 5:
        return ImageResult(image.name, *model, error="not an image")
    found = [
        Detection(object="ape", confidence=0.5, translation_m=[0, 0, k + 1], rotation=[1, 0, 0, 0, 1, 0, 0, 0, 1])
        for k in range(number % 3)
    ]
    return ImageResult(image.name, *model, 640, 480, results=[RegionResult(detections=found)])


def run(
    path: Path, form: ResultFormat, images: list[Image] = IMAGES, stop_after: int = 100, **options: bool
) -> ResultFile:
    with ResultFile(path, form, [MODEL], **options) as output:
        for count, image in enumerate(output.unanswered(iter(images))):
            if count == stop_after:
                break
            output.write(form.lines([result(image)]))
    return output


@pytest.mark.parametrize("form", FORMATS)
def test_cut_off_at_any_byte_it_ends_as_if_uninterrupted(form: ResultFormat, tmp_path: Path) -> None:
    path = tmp_path / "out"
    run(path, form)
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        output = run(path, form)
        assert path.read_bytes() == whole, f"cut after {length} bytes"
        assert output.num_images == 6


@pytest.mark.parametrize("form", FORMATS[:2])
def test_errors_of_earlier_runs_are_counted(form: ResultFormat, tmp_path: Path) -> None:
    assert run(tmp_path / "out", form).num_errors == 1
    assert run(tmp_path / "out", form).num_errors == 1


def test_overwrite_starts_again(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.write_text("a shopping list\n")
    with pytest.raises(UsageError, match="a shopping"):
        run(path, JsonLines())
    assert path.read_text() == "a shopping list\n"
    run(path, JsonLines(), overwrite=True)
    assert path.read_bytes().count(b"\n") == 6
    whole = path.read_bytes()
    run(path, JsonLines(), [], overwrite=True)
    assert path.read_bytes() == whole, "without any image there is nothing to overwrite it with"


def test_images_without_a_name_in_the_format_cost_no_earlier_result(tmp_path: Path) -> None:
    form = Bop({"ape": 1})
    run(tmp_path / "out", form)
    before = (tmp_path / "out").read_bytes()
    with pytest.raises(UsageError, match="does not say its scene and image"):
        run(tmp_path / "out", form, [Image("folder/frame.png")], overwrite=True)
    assert (tmp_path / "out").read_bytes() == before


@pytest.mark.parametrize("form", FORMATS)
def test_other_images_are_refused_and_nothing_is_lost(form: ResultFormat, tmp_path: Path) -> None:
    path = tmp_path / "out"
    run(path, form, stop_after=5)
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"line \d+ .*--overwrite"):
        run(path, form, IMAGES[::-1])
    with pytest.raises(UsageError, match="not among the images given"):
        run(path, form, IMAGES[:1])
    assert path.read_bytes() == before


@pytest.mark.parametrize("form", FORMATS[:2])
@pytest.mark.parametrize("model", [("can", 1), ("ape", 2)])
def test_another_model_is_refused(form: ResultFormat, model: tuple[str, int], tmp_path: Path) -> None:
    run(tmp_path / "out", form, stop_after=2)
    with (
        ResultFile(tmp_path / "out", form, [model]) as output,
        pytest.raises(UsageError, match="ape version 1; this is"),
    ):
        output.unanswered(iter(IMAGES))


def test_other_options_are_refused_and_named(tmp_path: Path) -> None:
    path = tmp_path / "out"
    run(path, JsonLines({"reads": 3}), stop_after=2)
    before = path.read_bytes()
    assert b'"options": {"reads": 3}' in before
    for options in ({}, {"reads": 3, "plane": "objects"}):
        with pytest.raises(UsageError, match=r'other options: \{"reads": 3\} instead of \{'):
            run(path, JsonLines(options))
    assert path.read_bytes() == before
    assert run(path, JsonLines({"reads": 3})).num_images == 6


PAIR = [("ape", 1), ("can", 2)]


def run_pair(path: Path, form: ResultFormat, models: list[tuple[str, int]]) -> None:
    with ResultFile(path, form, models) as output:
        for image in output.unanswered(iter(IMAGES)):
            output.write(form.lines([result(image, model) for model in models]))


@pytest.mark.parametrize("form", FORMATS)
def test_of_two_models_cut_off_at_any_byte_it_ends_as_if_uninterrupted(form: ResultFormat, tmp_path: Path) -> None:
    path = tmp_path / "out"
    run_pair(path, form, PAIR)
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        run_pair(path, form, PAIR)
        assert path.read_bytes() == whole, length


@pytest.mark.parametrize("form", FORMATS[:2])
def test_a_file_of_fewer_or_more_models_is_refused(form: ResultFormat, tmp_path: Path) -> None:
    for found, now in ((PAIR[:1], PAIR), (PAIR, PAIR[:1]), (PAIR, PAIR[::-1])):
        path = tmp_path / "out"
        path.unlink(missing_ok=True)
        run_pair(path, form, found)
        with pytest.raises(UsageError, match=r"line \d+ holds results of model .*; this is "):
            run_pair(path, form, now)


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "out"
    run(path, JsonLines(), stop_after=3)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + b"\x00\x00\x00\n" + lines[2])
    with pytest.raises(UsageError, match="line 2"):
        run(path, JsonLines())


def test_a_longer_list_goes_on_where_the_shorter_ended(tmp_path: Path) -> None:
    path = tmp_path / "out"
    run(path, JsonLines(), IMAGES[:2])
    run(path, JsonLines(), IMAGES)
    assert path.read_bytes().count(b"\n") == 6


def test_two_processes_do_not_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "out"
    with path.open("wb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="another process"):
            ResultFile(path, JsonLines(), [MODEL])


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "out.jsonl", tmp_path):
        with pytest.raises(OutputError, match=str(path)):
            ResultFile(path, JsonLines(), [MODEL])


def test_missing_folders_are_made(tmp_path: Path) -> None:
    run(tmp_path / "a" / "b" / "out.jsonl", JsonLines())
    assert (tmp_path / "a" / "b" / "out.jsonl").stat().st_size


def test_folders_that_a_path_only_passes_through_are_not_made(tmp_path: Path) -> None:
    run(tmp_path / "a" / ".." / "b" / "out.jsonl", JsonLines())
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


@pytest.fixture
def limited_file_size() -> Iterator[int]:
    """The kernel refuses to let any file of this process grow beyond that: a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    yield 1000
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_complete_lines_and_says_so(tmp_path: Path, limited_file_size: int) -> None:
    path = tmp_path / "out"
    with pytest.raises(OutputError, match=r"out: File too large.*same command"):
        run(path, JsonLines())
    lines = path.read_bytes().splitlines(keepends=True)
    assert 0 < path.stat().st_size <= limited_file_size
    assert lines[-1].endswith(b"\n")
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    assert run(path, JsonLines()).num_images == 6


def test_a_pipe_is_written_through() -> None:
    program = (
        "from pathlib import Path\n"
        "from curio_serve.batch.results.result_file import ResultFile\n"
        "from curio_serve.batch.results.formats import ImageResult, Csv\n"
        "form = Csv()\n"
        "with ResultFile(None, form, [('ape', 1)]) as output:\n"
        "    list(output.unanswered(iter([])))\n"
        "    output.write(form.lines([ImageResult('x.png', 'ape', 1, error='no')]))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True, env=os.environ)
    header, row = done.stdout.splitlines()
    assert header == Csv.header.strip()
    assert row.startswith(b"x.png,")
