"""The golden image of a version: what it stores has to come out of the network here, or the version does not serve."""

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_serve.errors import ModelError
from curio_serve.models.model_check import ChildCheck
from curio_serve.models.model_folder import load_version
from curio_serve.models.repository import Repository


@pytest.fixture
def folder(models_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(models_dir, tmp_path / "models")) / "pinhole"


def _golden(folder: Path) -> dict[str, Any]:
    image = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
    outputs = load_version(folder, 1).run(image[None])
    return {"image": image, **{name: value[0] for name, value in outputs.items()}}


def test_a_network_that_computes_what_was_exported(folder: Path) -> None:
    np.savez(folder / "1" / "golden.npz", **_golden(folder))
    ChildCheck()(folder, 1)
    assert load_version(folder, 1).version == 1


def test_what_rounding_decides_is_not_compared(folder: Path) -> None:
    golden = _golden(folder)
    translation_m = np.array(golden["translation_m"])
    translation_m[0, 0] = np.nan
    np.savez(folder / "1" / "golden.npz", **golden | {"translation_m": translation_m})
    assert load_version(folder, 1).version == 1
    translation_m[0, 1] += 0.01
    np.savez(folder / "1" / "golden.npz", **golden | {"translation_m": translation_m})
    with pytest.raises(ModelError, match=r"translation_m is 0\.01 off"):
        load_version(folder, 1)


def test_another_networks_answer_is_refused_and_the_old_version_serves(folder: Path) -> None:
    repository = Repository(folder.parent, check=ChildCheck())
    repository.refresh()
    golden = _golden(folder)
    golden["translation_m"] = golden["translation_m"] + 0.01
    (folder / "SHA256SUMS").unlink()
    shutil.copytree(folder / "1", folder / "2")
    np.savez(folder / "2" / "golden.npz", **golden)
    refused = [change for change in repository.refresh() if change.event == "refused"]
    assert [change.version for change in refused] == [2]
    assert "translation_m is 0.01 off for the golden image" in refused[0].reason
    assert repository.get("pinhole").version == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image": np.zeros((8, 8, 3), np.uint8)}, r"image is uint8 \(8, 8, 3\)"),
        ({"image": np.zeros((64, 96, 3))}, "image is float64"),
        ({"depth": np.zeros(1)}, "depth .* is no output of the graph"),
        ({"translation_m": np.full((1, 3), np.nan)}, "is nan off"),
    ],
)
def test_golden_files_that_do_not_fit(folder: Path, change: dict[str, Any], words: str) -> None:
    np.savez(folder / "1" / "golden.npz", **(_golden(folder) | change))
    with pytest.raises(ModelError, match=words):
        load_version(folder, 1)


def _packed(method: int = zipfile.ZIP_DEFLATED, start: int = 0, change: bytes = b"") -> bytes:
    """An archive with one member, some of whose bytes are replaced."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("image.npy", bytes(5000))
    data = bytearray(stream.getvalue())
    data[start : start + len(change)] = change
    return bytes(data)


def _bare_array() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    return stream.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04 half",
        b"no archive",
        _packed(start=39, change=b"\xff\xff\xff\xff"),  # broken deflate
        _packed(start=_packed().index(b"PK\x01\x02") + 8, change=b"\1"),  # encrypted, as its directory says
        _packed(start=_packed().index(b"PK\x01\x02") + 10, change=b"\x63"),  # of an unknown method
        _bare_array(),
    ],
)
def test_golden_files_that_are_none(folder: Path, data: bytes) -> None:
    (folder / "1" / "golden.npz").write_bytes(data)
    with pytest.raises(ModelError, match=r"golden\.npz is not an archive of arrays"):
        load_version(folder, 1)


def test_pickles_are_refused(folder: Path) -> None:
    np.savez(folder / "1" / "golden.npz", image=np.array([{"a": 1}], object))
    with pytest.raises(ModelError, match="is not an archive of arrays"):
        load_version(folder, 1)
