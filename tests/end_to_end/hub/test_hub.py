"""A model goes to a hub and comes back: pushed, fetched once, checked, served offline, or one clear error."""

import json
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from curio_serve.client import PoseClient
from curio_serve.models.model_folder import versions
from curio_train.errors import ExportError, UsageError

hub_module = pytest.importorskip("curio_train.export.hub", reason="huggingface_hub is not installed: extra `hub`")
Call = Callable[..., "subprocess.CompletedProcess[str]"]
Push = Callable[..., str]
ROOT = Path(__file__).parents[3]
FRAME, CAMERA = ROOT / "samples" / "00.jpg", ROOT / "samples" / "camera.json"
NAME = "acme/ape"
(VERSION,) = versions(ROOT / "models" / "ape")
ADDRESS = f"hf://{NAME}"


def environment(hub: Any, folder: Path) -> dict[str, str]:
    cache = {"HF_HOME": str(folder / "hf"), "HF_HUB_ETAG_TIMEOUT": "1"}
    return cache | {"HF_ENDPOINT": hub.address, "HF_TOKEN": hub.token}


@pytest.fixture
def at_hub(hub: Any, call: Call, tmp_path: Path) -> Call:
    """``at_hub(command, *arguments, status=0, **variables)``: a command that asks the stand-in, cache in tmp_path."""

    def run(name: str, *arguments: str | Path, status: int = 0, **extra: str) -> "subprocess.CompletedProcess[str]":
        return call(name, *arguments, status=status, extra=environment(hub, tmp_path) | extra)

    return run


@pytest.fixture
def detect(at_hub: Call) -> Callable[..., str]:
    """``detect(model, status=0, **variables)``: the line of an image, or the error."""

    def run(model: str | Path, status: int = 0, **extra: str) -> str:
        done = at_hub("curio-detect", model, FRAME, "--camera", CAMERA, status=status, **extra)
        return done.stderr if status else done.stdout

    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a shipped model's folder."""
    return Path(shutil.copytree(ROOT / "models" / "ape", tmp_path / "models" / "ape"))


@pytest.fixture
def held(hub: Any, folder: Path) -> Any:
    """A private repository that holds the folder."""
    hub.repositories[NAME] = hub.new(private=True)
    hub.repositories[NAME].hold(folder)
    return hub.repositories[NAME]


@pytest.fixture
def push(hub: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """``push(folder, licence=None)``: as curio-export --push does it."""
    monkeypatch.setenv("HF_ENDPOINT", hub.address)
    monkeypatch.setenv("HF_TOKEN", hub.token)
    return lambda folder, licence=None: hub_module.push(folder, NAME, licence)


def test_a_folder_and_a_card_are_pushed_as_one_commit(hub: Any, push: Push, folder: Path) -> None:
    assert push(folder) == f"{hub.address}/{NAME}/commit/{1:040x}"
    repository = hub.repositories[NAME]
    assert repository.private
    assert len(repository.commits) == 2
    sent = dict(repository.commits[-1])
    local = [path for path in folder.rglob("*") if path.is_file()]
    assert len(local) == 8
    for path in local:
        assert sent.pop(path.relative_to(folder.parent).as_posix()) == path.read_bytes()
    assert sent.keys() == {".gitattributes", "README.md"}
    _, head, text = sent["README.md"].decode().split("---\n", 2)
    assert yaml.safe_load(head) == {
        "license": "cc-by-sa-4.0",  # of the mesh
        "library_name": "curio-pose",
        "pipeline_tag": "object-detection",
        "tags": ["pose-estimation", "6dof-pose-estimation", "onnx", "linemod", "ape"],
    }
    assert f"curio-detect {ADDRESS} images/ --camera camera.json" in text
    assert text.endswith((folder / "CARD.md").read_text())


def test_a_model_is_fetched_once_and_then_serves_offline(
    hub: Any, held: Any, detect: Callable[..., str], tmp_path: Path, serving: Callable[..., Any]
) -> None:
    found, expected = (json.loads(detect(model)) for model in (ADDRESS, ROOT / "models" / "ape"))
    assert {**found, "milliseconds": None} == {**expected, "milliseconds": None}
    of_version = [f"{VERSION}/{name}" for name in ("golden.npz", "model.onnx", "reliability.json", "stable_poses.json")]
    assert sorted(hub.downloads) == [f"ape/{name}" for name in (*of_version, "CARD.md", "SHA256SUMS", "config.pbtxt")]
    hub.downloads.clear()
    offline = environment(hub, tmp_path) | {"HF_HUB_OFFLINE": "1"}
    with serving(ADDRESS, offline) as address, PoseClient(address) as client:
        assert [(model.name, list(model.versions)) for model in client.list_models()] == [("ape", [VERSION])]
    assert hub.downloads == []


def test_the_cache_stands_in_for_a_hub_that_is_out_of_order(
    hub: Any, held: Any, at_hub: Call, detect: Callable[..., str]
) -> None:
    detect(ADDRESS)
    hub.is_broken = True
    done = at_hub("curio-detect", ADDRESS, FRAME, "--camera", CAMERA)
    assert json.loads(done.stdout)["detections"]
    assert f"curio-detect: {ADDRESS}: the hub answers 500; the copy in the cache is used" in done.stderr


def test_a_revision_is_named(held: Any, detect: Callable[..., str]) -> None:
    held.tags["first"] = 1
    held.commits.append({"README.md": b"emptied"})
    assert json.loads(detect(f"{ADDRESS}@first"))["model"] == {"name": "ape", "version": VERSION}
    assert f"{ADDRESS}@second: the repository has no such revision" in detect(f"{ADDRESS}@second", status=2)


def test_what_cannot_be_fetched_is_said(hub: Any, held: Any, detect: Callable[..., str]) -> None:
    assert "expected hf://ORG/NAME" in detect("hf://ape", 2)
    assert "or it is private: log in (hf auth login) or set HF_TOKEN" in detect(ADDRESS, 2, HF_TOKEN="")
    assert "the cache has no whole copy of it" in detect(ADDRESS, 1, HF_HUB_OFFLINE="1")
    hub.repositories["acme/text"] = hub.new(private=False)
    hub.repositories["acme/text"].commits.append({"README.md": b"", "onnx/model.onnx": b"0" * 1000})
    assert "holds no model of curio's" in detect("hf://acme/text", 1)
    assert hub.downloads == []
    held.commits[-1][f"ape/{VERSION}/model.onnx"] += b"0"
    assert "but SHA256SUMS says" in detect(ADDRESS, 1)


def test_a_hub_that_does_not_answer(at_hub: Call) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the system takes connections, and nobody answers
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        said = at_hub("curio-serve", ADDRESS, status=1, HF_ENDPOINT=address).stderr
    assert "the hub does not answer" in said
    assert "the cache has no whole copy of it" in said


def test_a_push_over_another_model_or_version_is_refused(held: Any, push: Push, folder: Path) -> None:
    with pytest.raises(UsageError, match="holds the model ape; push lmo"):
        push(ROOT / "models" / "lmo")
    held.commits[-1]["ape/SHA256SUMS"] += b"0" * 64 + b"  100/model.onnx\n"
    with pytest.raises(ExportError, match="its version 100 is missing or another one"):
        push(folder)
    assert len(held.commits) == 2


def test_two_pushes_at_once_do_not_overwrite_each_other(hub: Any, held: Any, push: Push, folder: Path) -> None:
    hub.before_commit = lambda: held.commits.append(held.commits[-1] | {"NOTES": b"from another"})
    with pytest.raises(ExportError, match="somebody else has changed it meanwhile"):
        push(folder)
    assert held.commits[-1]["NOTES"] == b"from another"


def test_the_hub_says_what_it_does_not_take(push: Push, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ExportError, match='"license" must be one of'):
        push(folder, "mine")
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(UsageError, match="set HF_TOKEN"):
        push(folder)


def test_a_damaged_folder_is_not_pushed(hub: Any, push: Push, folder: Path) -> None:
    sums = folder / "SHA256SUMS"
    sums.write_text(sums.read_text().replace("a", "b"))
    with pytest.raises(ExportError, match="SHA256SUMS says"):
        push(folder)
    assert not hub.repositories
