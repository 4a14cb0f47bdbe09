"""URLs without a store: a web server that is overloaded at first, schemes that are refused, the extra missing."""

import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from curio_serve.batch.images import sources
from curio_serve.batch.images.remote_files import Patience, RemoteFiles, path_of
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.errors import ImageError, UsageError

pytest.importorskip("aiohttp", reason="aiohttp is not installed: extra `cloud`")
HASTY = Patience(timeout_s=0.5, num_attempts=3, first_wait_s=0.01)
MAX_BYTES = 1 << 20
DETECT = "from curio_serve.batch.detect_cli import main; main()"


def detect(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", DETECT, *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.parametrize(
    ("url", "path"),
    [
        ("s3://bucket/a#1.jpg", "s3/bucket/a#1.jpg"),
        ("s3://bucket/what?.jpg", "s3/bucket/what?.jpg"),
        ("https://host/a.jpg#top", "https/host/a.jpg"),
    ],
)
def test_keys_of_stores_may_hold_any_character(url: str, path: str) -> None:
    assert path_of(url) == path


@pytest.mark.parametrize("url", ["s3://my.bucket", "s3://my.bucket/", "s3://my.bucket/day"])
def test_a_dot_in_a_buckets_name_is_no_suffix(url: str) -> None:
    assert sources._is_remote_folder(url)
    assert not sources._is_remote_folder("s3://my.bucket/a.jpg")


@pytest.fixture
def flaky() -> Iterator[tuple[str, list[str]]]:
    """A web server that is overloaded twice before each answer, and the paths that it was asked for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            status = 404 if "missing" in self.path else 200 if asked.count(self.path) > 2 else 503
            self.send_response(status)
            self.send_header("Content-Length", "4")
            self.end_headers()
            self.wfile.write(b"good")

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    thread.join()
    server.server_close()


def test_what_fails_for_a_while_is_asked_for_again_and_what_is_missing_once(flaky: tuple[str, list[str]]) -> None:
    address, asked = flaky
    files = RemoteFiles("http", HASTY)
    assert files.read(f"{address}/a.png", MAX_BYTES) == b"good"
    assert asked == ["/a.png"] * 3
    with pytest.raises(ImageError, match="No such file"):
        files.read(f"{address}/missing.png", MAX_BYTES)
    assert asked.count("/missing.png") == 1


def test_schemes_that_cannot_be_used_are_said(models_dir: Path) -> None:
    with pytest.raises(UsageError, match="expected s3://, gs://, http:// or https://"):
        RemoteFiles("ftp")
    done = detect(models_dir / "flat", "samples", "--out", "https://127.0.0.1/poses.jsonl")
    assert done.returncode == 2
    assert "cannot be written; expected a file, s3://" in done.stderr


def test_without_the_extra_it_says_what_to_install_and_files_do_without(models_dir: Path) -> None:
    blocked = "import sys\nfor name in ('fsspec', 's3fs', 'aiohttp'): sys.modules[name] = None\n" + DETECT
    arguments = [str(models_dir / "flat"), "s3://pictures/day/"]
    done = subprocess.run([sys.executable, "-c", blocked, *arguments], capture_output=True, text=True)
    assert done.returncode == 2
    assert "pip install 'curio-pose[cloud]'" in done.stderr
    done = subprocess.run([sys.executable, "-c", blocked, arguments[0], "samples"], capture_output=True, text=True)
    assert len(done.stdout.splitlines()) == 4, done.stderr


def test_a_folder_of_googles_store_where_nothing_is_yet_is_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the folder of results is before the first of them."""
    pytest.importorskip("gcsfs", reason="gcsfs is not installed: extra `cloud`")

    class Empty(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            is_list = self.path.partition("?")[0].endswith("/o")
            content = b'{"kind": "storage#objects"}' if is_list else b"{}"
            self.send_response(200 if is_list else 404)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Empty)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{server.server_port}")
    try:
        assert list(RemoteFiles("gs", HASTY).below("gs://bucket/poses.jsonl/")) == []
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_paths_of_urls_are_their_own() -> None:
    urls = ("https://h/img?id=1", "https://h/img?id=2", "https://h/img", "s3://h/img", "https://h/img.jpg?v=1")
    paths = [path_of(url) for url in urls]
    assert len(set(paths)) == len(urls)
    assert paths[2:4] == ["https/h/img", "s3/h/img"]
    assert paths[4].endswith(".jpg"), "drawings keep the kind of image"


def test_the_number_of_an_image_is_not_in_its_query() -> None:
    """``scene_camera.json`` has K by that number."""
    for query in range(20):
        image = SourceImage("a", f"https://h/000001/rgb/000003.png?token={query}#{query}")
        assert re.findall(r"\d+", Path(image.numbered_name).stem) == ["000003"]
        assert path_of(image.path) == image.relative_name != image.numbered_name
    assert SourceImage("a", "s3://b/rgb/7?8.png").numbered_name.endswith("7?8.png")
    assert SourceImage("a", "clip.mp4", 5).numbered_name == SourceImage("a", "clip.mp4", 5).relative_name


def test_a_url_of_another_kind_is_an_error_of_that_image(models_dir: Path, tmp_path: Path) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text(f"ftp://h/a.png\n{tmp_path / 'missing.png'}\n")
    with listed.open() as names:
        command = [sys.executable, "-c", DETECT, str(models_dir / "flat"), "-"]
        done = subprocess.run(command, stdin=names, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert "ftp://: not supported" in lines[0]["error"]
    assert "missing.png" in lines[1]["image"]
