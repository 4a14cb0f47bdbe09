"""Downloading LineMOD from a stand-in for the hub: resumed, checked, unpacked inside its folder, or one clear error."""

import hashlib
import io
import json
import os
import pty
import socket
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import trimesh
from curio_train.commands import train as train_command
from curio_train.data.bop import BopDataset
from curio_train.data.download import (
    SCORING_ARCHIVES,
    TRAINING_ARCHIVES,
    download_bytes,
    download_linemod,
    missing_archives,
)
from curio_train.errors import DataError

COMMIT = "c0ffee" * 6 + "c0ff"
CHUNK = 10 * 1024 * 1024  # huggingface_hub writes nothing smaller
FRAME_BYTES = CHUNK + 100_000
CAMERA = {"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480}


def archive(files: dict[str, bytes | str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as content:
        for name, data in files.items():
            content.writestr(name, data)
    return buffer.getvalue()


class Hub(ThreadingHTTPServer):
    """Metadata and a redirect to storage, as the hub answers; what to say wrongly is set by each test."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        mesh = trimesh.creation.box((60, 60, 60)).export(file_type="ply")
        self.files = {
            "lm_base.zip": archive({"lm/camera.json": json.dumps(CAMERA), "lm/test_targets_bop19.json": "[]"}),
            "lm_models.zip": archive({"models/obj_000001.ply": mesh, "models/models_info.json": "{}"}),
            "lm_test_all.zip": archive(
                {"test/000001/scene_gt.json": "{}", "test/000001/rgb/000000.png": b"0" * FRAME_BYTES}
            ),
        }
        self.digests = {name: hashlib.sha256(data).hexdigest() for name, data in self.files.items()}
        self.sizes = {name: len(data) for name, data in self.files.items()}
        self.refusal: tuple[int, str] | None = None
        self.breaks_at: int | None = None  # a transfer breaks off there, and none is continued
        self.asked: list[tuple[str, str | None]] = []


class Answer(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *args: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self.answer(body=False)

    def do_GET(self) -> None:
        self.answer(body=True)

    def answer(self, *, body: bool) -> None:
        hub, name = self.server, self.path.rsplit("/", 1)[-1]
        if hub.refusal is not None:
            self.reply(hub.refusal[0], {"X-Error-Code": hub.refusal[1], "Content-Length": "0"})
        elif self.path.startswith("/datasets/bop-benchmark/lm/resolve/") and name in hub.files:
            linked = {"X-Linked-Etag": f'"{hub.digests[name]}"', "X-Linked-Size": str(hub.sizes[name])}
            storage = f"http://localhost:{hub.server_port}/storage/{name}"  # another host, as the hub's is
            place = {"Location": storage, "X-Repo-Commit": COMMIT, "Content-Length": "0"}
            self.reply(302, linked | place)
        elif self.path.startswith("/storage/") and body:
            self.send(name, hub.files[name])
        else:
            self.reply(404, {"X-Error-Code": "EntryNotFound", "Content-Length": "0"})

    def reply(self, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def send(self, name: str, data: bytes) -> None:
        hub, wanted = self.server, self.headers["Range"]
        hub.asked.append((name, wanted))
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted else 0
        if hub.breaks_at is not None and wanted:
            self.reply(503, {"Content-Length": "0"})
            return
        self.reply(206 if wanted else 200, {"Content-Length": str(len(data) - start)})
        self.wfile.write(data[start : hub.breaks_at])
        self.close_connection = True


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    server = Hub()
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    yield server
    server.shutdown()
    server.server_close()


def test_training_fetches_no_frames(hub: Hub, tmp_path: Path) -> None:
    assert missing_archives(tmp_path) == list(TRAINING_ARCHIVES)
    assert download_bytes(TRAINING_ARCHIVES) == hub.sizes["lm_base.zip"] + hub.sizes["lm_models.zip"]
    assert not (download_linemod(tmp_path) / "test").exists()
    assert missing_archives(tmp_path) == []
    assert missing_archives(tmp_path, SCORING_ARCHIVES) == ["lm_test_all.zip"]


def test_a_data_set_is_fetched_once(hub: Hub, tmp_path: Path) -> None:
    folder = download_linemod(tmp_path, SCORING_ARCHIVES)
    assert BopDataset(folder).classes == ("ape",)
    assert BopDataset(folder).camera.width == 640
    assert (folder / "test/000001/rgb/000000.png").stat().st_size == FRAME_BYTES
    assert [name for name, _ in hub.asked] == list(SCORING_ARCHIVES)
    assert not list(tmp_path.rglob("*.part"))
    hub.refusal = (500, "")
    assert download_linemod(tmp_path, SCORING_ARCHIVES) == folder


def test_an_interrupted_download_is_continued(hub: Hub, tmp_path: Path) -> None:
    hub.breaks_at = CHUNK + 40_000
    with pytest.raises(DataError, match=r"503.*what has arrived is kept: give the same command again"):
        download_linemod(tmp_path, SCORING_ARCHIVES)
    (part,) = tmp_path.rglob("*.part")
    assert part.stat().st_size == CHUNK
    assert part.read_bytes() == hub.files["lm_test_all.zip"][:CHUNK]
    hub.breaks_at = None
    hub.asked.clear()
    folder = download_linemod(tmp_path, SCORING_ARCHIVES)
    assert hub.asked == [("lm_test_all.zip", f"bytes={CHUNK}-")]
    assert (folder / "test/000001/rgb/000000.png").stat().st_size == FRAME_BYTES


def test_a_damaged_archive_is_thrown_away(hub: Hub, tmp_path: Path) -> None:
    whole = hub.files["lm_models.zip"]
    hub.files["lm_models.zip"] = whole[:-1] + b"?"
    with pytest.raises(DataError, match=r"lm_models\.zip: its SHA-256 is .*, the hub says .*thrown away"):
        download_linemod(tmp_path)
    assert not list(tmp_path.rglob("*.part"))
    assert not list(tmp_path.rglob("models"))
    hub.files["lm_models.zip"] = whole
    assert BopDataset(download_linemod(tmp_path)).classes == ("ape",)


def link(name: str) -> bytes:
    member = zipfile.ZipInfo(name)
    member.external_attr = 0o120777 << 16
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as content:
        content.writestr(member, "/etc")
    return buffer.getvalue()


def marked(position: int, byte: bytes) -> bytes:
    """An archive whose headers have that byte: its flags are at 6, its method at 8, two bytes later at its end."""
    data = bytearray(archive({"fine": "x"}))
    for signature, offset in ((b"PK\x03\x04", position), (b"PK\x01\x02", position + 2)):
        data[data.index(signature) + offset : data.index(signature) + offset + 1] = byte
    return bytes(data)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (archive({"fine": "", "lm/../../out": "x"}), "would be written outside"),
        (archive({"fine": "", "/out": "x"}), "would be written outside"),
        (archive({"fine": "", "..\\out": "x"}), "would be written outside"),
        (link("models"), "is a link"),
        (b"no archive", "damaged as published"),
        (archive({".": "x"}), "would be written outside"),
        (marked(6, b"\x01"), "damaged as published .*encrypted"),
        (marked(8, b"\x63"), "damaged as published .*not supported"),
    ],
)
def test_archives_that_cannot_be_unpacked_leave_nothing(hub: Hub, tmp_path: Path, content: bytes, text: str) -> None:
    hub.files["lm_base.zip"] = content
    hub.digests["lm_base.zip"], hub.sizes["lm_base.zip"] = hashlib.sha256(content).hexdigest(), len(content)
    with pytest.raises(DataError, match=text):
        download_linemod(tmp_path / "cache")
    left = [path for path in tmp_path.rglob("*") if path.is_file() and ".download" not in path.parts]
    assert not left


@pytest.mark.parametrize(
    ("refusal", "text"),
    [
        ((403, "GatedRepo"), "owners ask for consent first.*hf auth login"),
        ((404, "EntryNotFound"), "the hub answers 404; .*--data DIR"),
        ((401, "RepoNotFound"), "the hub answers 401; .*--data DIR"),
        ((500, ""), "500.*--data DIR"),
    ],
)
def test_refusals_are_told(hub: Hub, tmp_path: Path, refusal: tuple[int, str], text: str) -> None:
    hub.refusal = refusal
    with pytest.raises(DataError, match=f"cannot download bop-benchmark/lm to .*{text}") as caught:
        download_linemod(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_disk_that_is_too_small_is_told_first(hub: Hub, tmp_path: Path) -> None:
    hub.sizes["lm_base.zip"] = 10**18
    with pytest.raises(DataError, match=r"lm_base\.zip: needs 1000000000\.00 GB, .* GB left; make room"):
        download_linemod(tmp_path)
    assert not hub.asked


def test_a_hub_without_checksums_is_refused(hub: Hub, tmp_path: Path) -> None:
    hub.digests["lm_base.zip"] = "abc"
    with pytest.raises(DataError, match="checksum abc, expected a SHA-256"):
        download_linemod(tmp_path)


def test_places_that_cannot_be_written_are_told(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "bop").write_text("a file where a folder is to be")
    with pytest.raises(DataError, match=r"cannot download .*(Not a directory|File exists).*--cache"):
        download_linemod(tmp_path)


def train(*flags: str) -> int:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["linemod", "--class", "duck", *flags])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


def test_the_command_downloads_unless_data_is_given(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ("--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "run"))
    monkeypatch.chdir(tmp_path)
    assert train(*flags, "--data", str(tmp_path / "nowhere"), "--download") == 1
    assert "there is no such folder" in capsys.readouterr().err
    assert not hub.asked
    assert train(*flags) == 1
    told = capsys.readouterr().err
    assert (
        "LineMOD's archives lm_base.zip, lm_models.zip (bop-benchmark/lm, CC BY 4.0): 0.0 MB, about 1 min at 10 Mbit/s"
        in told
    )
    assert "[Y/n]" not in told, "nobody is there to be asked"
    assert "no mesh of duck here; found meshes of: ape" in told
    assert [name for name, _ in hub.asked] == list(TRAINING_ARCHIVES)
    assert train(*flags) == 1
    assert "Mbit/s" not in capsys.readouterr().err, "it is there"
    assert not (tmp_path / "run").exists()


def test_a_wrong_class_is_refused_before_any_download(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train("--class", "dukc", "--cache", str(tmp_path)) == 2
    assert "found 'dukc' (did you mean duck?), expected one of ape" in capsys.readouterr().err
    assert not hub.asked


def test_a_trained_model_is_named(
    hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for model, objects in (("ape", ("ape",)), ("three", ("ape", "duck", "can"))):
        (tmp_path / "models" / model).mkdir(parents=True)
        rows = "".join(f"| {name} | 0.1 m |\n" for name in objects)
        (tmp_path / "models" / model / "CARD.md").write_text(
            f"# {model}\n\n| object | diameter |\n| --- | --- |\n{rows}"
        )
    monkeypatch.chdir(tmp_path)
    assert train("--cache", str(tmp_path)) == 1
    assert "trained for duck already: models/three; to try one, curio-detect models/three" in capsys.readouterr().err


@pytest.mark.parametrize(("typed", "status", "fetched"), [("n\n", 2, 0), ("\n", 1, 2), ("y\n", 1, 2)])
def test_on_a_terminal_the_download_is_a_question(
    hub: Hub, tmp_path: Path, typed: str, status: int, fetched: int
) -> None:
    """In a process of its own, whose terminal is a pseudo-terminal."""
    ours, theirs = pty.openpty()
    command = [Path(sys.executable).with_name("curio-train"), "linemod", "--class", "duck", "--cache", tmp_path]
    with subprocess.Popen(command, stdin=theirs, stderr=theirs, stdout=subprocess.DEVNULL, cwd=tmp_path) as process:
        os.close(theirs)
        told = b""
        while b"[Y/n]" not in told:
            told += os.read(ours, 1024)
        os.write(ours, typed.encode())
        with suppress(OSError):  # raised at the end of a pseudo-terminal's output
            while more := os.read(ours, 1024):
                told += more
    os.close(ours)
    assert process.returncode == status, told.decode()
    assert len(hub.asked) == fetched


def test_no_network_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{port}")
    assert train("--download", "--cache", str(tmp_path)) == 1
    told = capsys.readouterr().err
    assert f"cannot ask http://127.0.0.1:{port} for the size of bop-benchmark/lm" in told
    assert "onnection refused; try again with a network" in told
    assert "--data DIR" in told
