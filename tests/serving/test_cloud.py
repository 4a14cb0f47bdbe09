"""Images and results in an S3 server on loopback, and behind HTTP: refused, vanished, changed, silent, killed."""

import importlib.util
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.batch.images.remote_files import Patience, RemoteFiles
from curio_serve.batch.images.sources import PassedOver, images
from curio_serve.command_line import parsed
from curio_serve.errors import CurioError, ImageError, Unavailable

boto3 = pytest.importorskip("boto3", reason="moto is not installed: extra `dev`")
pytest.importorskip("s3fs", reason="s3fs is not installed: extra `cloud`")
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: extra `ray`")
HASTY = Patience(timeout_s=0.5, num_attempts=3, first_wait_s=0.01)
MAX_BYTES = 1 << 20
DETECT = "from curio_serve.batch.detect_cli import main; main()"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


def environment(endpoint: str) -> dict[str, str]:
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "id",
        "AWS_SECRET_ACCESS_KEY": "key",
        "AWS_DEFAULT_REGION": "us-east-1",
    }


def forget_connections() -> None:
    import s3fs
    from curio_serve.batch.images.remote_files import _opened

    s3fs.S3FileSystem.clear_instance_cache()
    _opened.cache_clear()


@pytest.fixture
def bucket(endpoint: str, monkeypatch: pytest.MonkeyPatch, spot_image: Callable[..., np.ndarray]) -> Iterator[Any]:
    """A bucket with 40 frames, one file that is no picture, and a text."""
    for name, value in environment(endpoint).items():
        monkeypatch.setenv(name, value)
    forget_connections()
    found = boto3.resource("s3").create_bucket(Bucket="pictures")
    for number in range(40):
        pixels = spot_image(160, 120, 50 + number, 60, 8, 8, (255, 128, 0))
        found.put_object(Key=f"day/{number // 20}/{number:04d}.png", Body=cv2.imencode(".png", pixels)[1].tobytes())
    found.put_object(Key="day/0/0005b.png", Body=b"nothing")
    found.put_object(Key="day/notes.txt", Body=b"a note")
    yield found
    found.objects.all().delete()
    found.delete()
    forget_connections()


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-c", DETECT, *map(str, arguments)]


def detect(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """In this process, with connections of its own: another process imports s3fs again, which takes a second."""
    forget_connections()
    told = io.StringIO()
    with redirect_stderr(told):
        try:
            status = run(parsed(DetectArguments, list(map(str, arguments)), "curio-detect"))
        except CurioError as exc:
            status = exc.exit_status
            print(exc, file=told)
    return subprocess.CompletedProcess(arguments, status, "", told.getvalue())


def detect_in_a_process(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(command(*arguments), capture_output=True, text=True, env=os.environ)


def without_times(lines: bytes) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in lines.splitlines()]
    for line in found:
        line.pop("milliseconds", None)
    return found


def joined(bucket: Any, folder: str) -> bytes:
    keys = sorted(entry.key for entry in bucket.objects.filter(Prefix=folder + "/"))
    return b"".join(bucket.Object(key).get()["Body"].read() for key in keys)


def test_a_folder_of_a_bucket_is_answered_in_order_with_its_errors(
    models_dir: Path, bucket: Any, tmp_path: Path
) -> None:
    out, drawn = tmp_path / "poses.jsonl", tmp_path / "drawn"
    done = detect_in_a_process(models_dir / "flat", "s3://pictures/day/", "--out", out, "--overlays", drawn)
    assert done.returncode == 1, done.stderr
    assert "1 image has no answer" in done.stderr
    assert "passed over: 1 file is no image: s3://pictures/day/notes.txt" in done.stderr
    lines = without_times(out.read_bytes())
    names = sorted(f"s3://pictures/{entry.key}" for entry in bucket.objects.filter(Prefix="day/"))
    assert [line["image"] for line in lines] == [name for name in names if name.endswith(".png")]
    assert [line["image"] for line in lines if "error" in line] == ["s3://pictures/day/0/0005b.png"]
    assert (drawn / "s3/pictures/day/1/0039.png").exists()


def test_a_list_of_urls_names_images_and_a_missing_one_is_a_line_of_its_own(
    models_dir: Path, bucket: Any, tmp_path: Path
) -> None:
    bucket.put_object(Key="list.txt", Body=b"day/0/0001.png\n\ns3://pictures/day/0/missing.png\r\nday/1/0020.png\n")
    out = tmp_path / "poses.jsonl"
    assert detect(models_dir / "flat", "s3://pictures/list.txt", "--out", out).returncode == 1
    first, missing, last = without_times(out.read_bytes())
    assert first["image"] == "s3://pictures/day/0/0001.png"
    assert first["detections"]
    assert missing["error"] == "cannot be read: No such file or directory"
    assert last["detections"]


def test_a_bucket_that_refuses_or_is_missing_is_said(models_dir: Path, bucket: Any, endpoint: str) -> None:
    done = detect(models_dir / "flat", "s3://nowhere/day/")
    assert done.returncode == 2
    assert "s3://nowhere/day/: cannot be listed: The specified bucket does not exist" in done.stderr
    set_free_calls(endpoint, 0)
    try:
        done = detect_in_a_process(models_dir / "flat", "s3://pictures/day/")
        with pytest.raises(ImageError, match="cannot be read"):
            RemoteFiles("s3", HASTY).read("s3://pictures/day/0/0001.png", MAX_BYTES)
    finally:
        set_free_calls(endpoint, 1 << 40)
    assert done.returncode == 2
    assert "s3://pictures/day/: cannot be listed: " in done.stderr
    assert "Traceback" not in done.stderr


def set_free_calls(endpoint: str, count: int) -> None:
    """So many calls until the server asks for a key that it knows."""
    headers = {"Content-Type": "text/plain"}
    request = urllib.request.Request(f"{endpoint}/moto-api/reset-auth", str(count).encode(), headers)
    urllib.request.urlopen(request).close()


def test_an_object_that_vanishes_after_it_was_listed_is_an_error_of_that_image(bucket: Any) -> None:
    found = list(images(["s3://pictures/day/0/"], PassedOver()))
    bucket.Object("day/0/0003.png").delete()
    with pytest.raises(ImageError, match="No such file"):
        found[3].read()
    assert found[4].read()


def test_an_object_that_changes_is_read_as_before_or_as_after(bucket: Any) -> None:
    contents = [bytes([value]) * (900_000 + value) for value in (1, 2)]
    bucket.put_object(Key="changing.png", Body=contents[0])
    is_done = threading.Event()

    def change() -> None:
        while not is_done.is_set():
            for content in contents:
                bucket.put_object(Key="changing.png", Body=content)

    changing = threading.Thread(target=change)
    changing.start()
    try:
        seen = [RemoteFiles("s3").read("s3://pictures/changing.png", MAX_BYTES) for _ in range(40)]
    finally:
        is_done.set()
        changing.join()
    assert all(content in contents for content in seen)


def test_an_object_that_is_too_large_or_empty(bucket: Any) -> None:
    bucket.put_object(Key="large.png", Body=bytes(2000))
    bucket.put_object(Key="empty.png", Body=b"")
    with pytest.raises(ImageError, match="more than 1999 bytes"):
        RemoteFiles("s3").read("s3://pictures/large.png", 1999)
    assert len(RemoteFiles("s3").read("s3://pictures/large.png", 2000)) == 2000
    with pytest.raises(ImageError, match="cannot be read"):
        RemoteFiles("s3", HASTY).read("s3://pictures/empty.png", 1999)


def test_a_listing_goes_over_many_pages(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MOTO_S3_DEFAULT_MAX_KEYS", "50")  # a page; 1000 as in S3 would take many objects
    client = boto3.client("s3")
    for number in range(110):
        client.put_object(Bucket="pictures", Key=f"many/{number:05d}.png", Body=b"")
    assert client.list_objects_v2(Bucket="pictures", Prefix="many/")["KeyCount"] == 50
    names = [image.name for image in images(["s3://pictures/many"], PassedOver())]
    assert names == [f"s3://pictures/many/{number:05d}.png" for number in range(110)]


@pytest.fixture
def silent() -> Iterator[str]:
    """A server that accepts connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"


def test_a_store_that_goes_silent_ends_the_run_and_a_web_server_an_image(
    bucket: Any, silent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", silent)
    forget_connections()
    with pytest.raises(Unavailable, match="no answer after 3 attempts: it did not answer in time"):
        RemoteFiles("s3", HASTY).read("s3://pictures/day/0/0001.png", MAX_BYTES)
    with pytest.raises(ImageError, match="no answer after 3 attempts"):
        RemoteFiles("http", HASTY).read(f"{silent}/a.png", MAX_BYTES)


def test_parts_joined_are_the_file_of_a_local_run_after_a_stop_and_a_kill(
    models_dir: Path, bucket: Any, tmp_path: Path
) -> None:
    here, there = tmp_path / "here.jsonl", "s3://pictures/out/poses.jsonl"
    detect(models_dir / "flat", "s3://pictures/day/", "--out", here)
    (tmp_path / "some").write_bytes(b"".join(here.read_bytes().splitlines(keepends=True)[:12]))
    program = (
        "import os, signal, sys\n"
        "from curio_serve.batch.results.formats import ImageLines, JsonLines\n"
        "from curio_serve.batch.results.result_parts import ResultParts\n"
        f"with ResultParts({there!r}, JsonLines(), [('flat', 1)], every_s=float(sys.argv[2])) as parts:\n"
        "    parts.unanswered(iter(()))\n"
        "    for line in open(sys.argv[1], 'rb'):\n"
        "        parts.write(ImageLines('', '', line))\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", program, tmp_path / "some", "0"])
    assert killed.returncode == -signal.SIGKILL
    assert joined(bucket, "out/poses.jsonl") == (tmp_path / "some").read_bytes()
    done = detect_in_a_process(models_dir / "flat", "s3://pictures/day/", "--out", there)
    assert done.returncode == 1, done.stderr
    assert without_times(joined(bucket, "out/poses.jsonl")) == without_times(here.read_bytes())
    again = detect(models_dir / "flat", "s3://pictures/day/", "--out", there)
    assert again.returncode == 1
    assert without_times(joined(bucket, "out/poses.jsonl")) == without_times(here.read_bytes())


@pytest.mark.parametrize("form", ["csv", "jsonl"])
def test_a_run_over_more_images_goes_on_in_the_parts_of_a_shorter_one(
    models_dir: Path, bucket: Any, tmp_path: Path, form: str
) -> None:
    here, there = tmp_path / "here", f"s3://pictures/out/poses.{form}"
    first, both = ["s3://pictures/day/0/"], ["s3://pictures/day/0/", "s3://pictures/day/1/"]
    detect(models_dir / "flat", *both, "--out", here, "--format", form)
    detect(models_dir / "flat", *first, "--out", there, "--format", form)
    done = detect(models_dir / "flat", *both, "--out", there, "--format", form)
    assert done.returncode == 1, done.stderr
    names = [entry.key for entry in bucket.objects.filter(Prefix="out/")]
    if form == "jsonl":
        assert names == ["out/poses.jsonl/part-00000.jsonl", "out/poses.jsonl/part-00001.jsonl"]
        assert without_times(joined(bucket, "out/poses.jsonl")) == without_times(here.read_bytes())
    else:
        assert len(joined(bucket, "out/poses.csv").splitlines()) == len(here.read_bytes().splitlines())
    done = detect(models_dir / "flat", *first, "--out", there, "--format", form, "--overwrite")
    assert [entry.key for entry in bucket.objects.filter(Prefix="out/")] == [f"out/poses.{form}/part-00000.{form}"]


def test_parts_of_something_else_and_parts_that_are_missing_are_refused(models_dir: Path, bucket: Any) -> None:
    there = "s3://pictures/out/poses.jsonl"
    bucket.put_object(Key="out/poses.jsonl/part-00001.jsonl", Body=b"{}\n")
    done = detect(models_dir / "flat", "s3://pictures/day/", "--out", there)
    assert done.returncode == 2
    assert "part-00000.jsonl is missing" in done.stderr
    bucket.put_object(Key="out/poses.jsonl/notes.md", Body=b"mine")
    done = detect(models_dir / "flat", "s3://pictures/day/", "--out", there, "--overwrite")
    assert "notes.md, which is no part of results" in done.stderr
    assert joined(bucket, "out/poses.jsonl") == b"mine{}\n"


def test_parts_are_replaced_only_once_there_are_images(models_dir: Path, bucket: Any) -> None:
    there = "s3://pictures/out/poses.jsonl"
    bucket.put_object(Key="out/poses.jsonl/part-00000.jsonl", Body=b"{}\n")
    done = detect(models_dir / "flat", "s3://pictures/night/", "--out", there, "--overwrite")
    assert done.returncode == 2
    assert joined(bucket, "out/poses.jsonl") == b"{}\n"


def workers_below(root: int) -> list[int]:
    """Ray's actors that hold the model, among the processes below one."""
    parents, workers = {}, []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if b"MapWorker" in (entry / "cmdline").read_bytes():
                workers.append(int(entry.name))

    def is_below(number: int) -> bool:
        return number == root or (number in parents and is_below(parents[number]))

    return [number for number in workers if is_below(number)]


@needs_ray
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are found in /proc")
def test_a_killed_worker_loses_no_image_of_a_cluster_and_answers_none_twice(
    models_dir: Path, bucket: Any, tmp_path: Path
) -> None:
    names = [f"day/{number // 20}/{number:04d}.png" for number in range(40)] * 50
    bucket.put_object(Key="list.txt", Body="\n".join(names).encode())
    out = tmp_path / "poses.jsonl"
    call = command(models_dir / "flat", "s3://pictures/list.txt", "--out", out, "--ray", "local")
    with subprocess.Popen(call, stderr=subprocess.PIPE, text=True) as process:
        while not out.exists() or not out.stat().st_size:
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        killed = workers_below(process.pid)[0]
        os.kill(killed, signal.SIGKILL)
        assert out.read_bytes().count(b"\n") < len(names)  # it had work left
        _, told = process.communicate()
    assert process.returncode == 0, told
    lines = [json.loads(line) for line in out.read_bytes().splitlines()]
    assert [line["image"] for line in lines] == [f"s3://pictures/{name}" for name in names]
    assert all(line["detections"] for line in lines)
