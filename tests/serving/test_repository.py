"""Models found, loaded, replaced and refused while others go on serving."""

import os
import resource
import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import pytest
from curio_serve.errors import CheckNotDone, ModelError, ModelNotFound
from curio_serve.models.model_check import ChildCheck
from curio_serve.models.model_folder import load_version, open_model
from curio_serve.models.repository import Repository

MakeOnnx = Callable[..., onnx.ModelProto]
WriteFolder = Callable[..., Path]
_NOBODY = 65534


@pytest.fixture
def root(models_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(models_dir, tmp_path / "models"))


def _events(repository: Repository) -> set[tuple[str, str, int]]:
    return {(change.event, change.name, change.version) for change in repository.refresh()}


def test_models_are_found_and_named(root: Path) -> None:
    (root / ".hidden" / "1").mkdir(parents=True)
    (root / "notes.txt").write_text("not a model")
    (root / "empty").mkdir()
    repository = Repository(root)
    assert _events(repository) == {("loaded", "flat", 1), ("loaded", "pinhole", 1)}
    assert [name for name, _ in repository] == ["flat", "pinhole"]
    assert repository.get("flat").version == 1
    assert repository.get("flat", 1) is repository.get("flat")
    assert _events(repository) == set()


@pytest.fixture
def guarded(models_dir: Path) -> Iterator[Path]:
    """Models in a folder where modes of files hold, also for tests that root runs."""
    is_root = os.geteuid() == 0
    with tempfile.TemporaryDirectory() as name:
        models = Path(shutil.copytree(models_dir, Path(name) / "models"))
        model = load_version(models / "flat", 1)
        image = np.zeros((model.camera.height, model.camera.width, 3), np.uint8)
        outputs = {output: value[0] for output, value in model.run(image[None]).items()}
        np.savez(models / "flat" / "1" / "golden.npz", image=image, **outputs)
        # Now, because nobody may not read the packages and codecs that this imports.
        assert len(Repository(models).refresh()) == 2
        for path in (Path(name), *Path(name).rglob("*")):
            path.chmod(0o755)
            os.chown(path, _NOBODY if is_root else -1, -1)
        try:
            os.seteuid(_NOBODY if is_root else os.geteuid())
            yield models
        finally:
            os.seteuid(os.getuid())


def test_a_model_that_cannot_be_read_stops_no_other(guarded: Path) -> None:
    (guarded / "flat").chmod(0)
    repository = Repository(guarded)
    changes = {change.name: change for change in repository.refresh()}
    assert changes["pinhole"].event == "loaded"
    assert (changes["flat"].event, changes["flat"].version) == ("refused", 0)
    assert changes["flat"].reason == f"model folder {guarded / 'flat'} cannot be read: Permission denied"
    assert repository.refresh() == [], "it was said already"
    (guarded / "flat").chmod(0o755)
    assert _events(repository) == {("loaded", "flat", 1)}
    loaded = repository.get("flat")
    (guarded / "flat").chmod(0)
    assert _events(repository) == {("refused", "flat", 0)}
    assert repository.get("flat") is loaded
    (guarded / "flat").chmod(0o755)
    assert _events(repository) == set()


@pytest.mark.parametrize("name", ["config.pbtxt", "SHA256SUMS", "1", "1/model.onnx", "1/golden.npz"])
def test_what_cannot_be_read_is_refused_until_it_can(guarded: Path, name: str) -> None:
    path = guarded / "flat" / name
    path.chmod(0)
    repository = Repository(guarded)
    changes = {change.name: change for change in repository.refresh()}
    assert changes["pinhole"].event == "loaded"
    assert (changes["flat"].event, changes["flat"].version) == ("refused", 1)
    assert "cannot be read: Permission denied" in changes["flat"].reason
    assert repository.refresh() == []
    path.chmod(0o755)
    assert _events(repository) == {("loaded", "flat", 1)}


@pytest.mark.parametrize("name", ["", "nothing", "../flat", "flat/1", "flat\0", "x" * 10_000])
def test_unknown_names(root: Path, name: str) -> None:
    repository = Repository(root)
    repository.refresh()
    with pytest.raises(ModelNotFound, match=r"loaded are \['flat', 'pinhole'\]"):
        repository.get(name)
    with pytest.raises(ModelNotFound, match="has no version 9"):
        repository.get("flat", 9)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"models folder .*nowhere cannot be read"):
        Repository(tmp_path / "nowhere").refresh()


def test_folders_that_are_no_versions_are_passed_over(root: Path) -> None:
    for name in ("007", "٣", "4294967296", "1" * 200, "v2", "0"):
        shutil.copytree(root / "flat" / "1", root / "flat" / name)
    repository = Repository(root)
    assert _events(repository) == {("loaded", "flat", 1), ("loaded", "pinhole", 1)}
    assert open_model(root / "flat").version == 1


def test_new_versions_come_and_old_ones_go(root: Path, spot_onnx: MakeOnnx, write_folder: WriteFolder) -> None:
    repository = Repository(root, num_versions=2, check=ChildCheck())
    repository.refresh()
    first = repository.get("flat")
    write_folder(root / "flat", spot_onnx(False), 2)
    assert _events(repository) == {("loaded", "flat", 1), ("loaded", "flat", 2)}
    assert repository.get("flat").version == 2
    write_folder(root / "flat", spot_onnx(False), 3)
    events = _events(repository)
    assert ("unloaded", "flat", 1) in events
    assert ("loaded", "flat", 3) in events
    # A call that holds a model keeps it alive, whatever happens to the folder.
    assert first.run(np.zeros((1, 64, 96, 3), np.uint8))
    shutil.rmtree(root / "flat")
    assert _events(repository) == {("unloaded", "flat", 2), ("unloaded", "flat", 3)}
    assert [name for name, _ in repository] == ["pinhole"]


def test_a_broken_version_changes_nothing(root: Path, spot_onnx: MakeOnnx, write_folder: WriteFolder) -> None:
    repository = Repository(root, num_versions=1, check=ChildCheck())
    repository.refresh()
    (root / "flat" / "2").mkdir()
    (root / "flat" / "2" / "model.onnx").write_bytes(b"half a file")
    [refused] = repository.refresh()
    assert (refused.event, refused.version) == ("refused", 2)
    assert "is not an ONNX file" in refused.reason
    assert repository.get("flat").version == 1
    assert repository.refresh() == [], "a refused file is not tried again until it changes"
    # A server that starts now serves the same.
    late = Repository(root, num_versions=1)
    assert _events(late) == {("refused", "flat", 2), ("loaded", "flat", 1), ("loaded", "pinhole", 1)}
    write_folder(root / "flat", spot_onnx(False), 2)
    assert ("loaded", "flat", 2) in _events(repository)
    assert repository.get("flat").version == 2


def test_a_file_replaced_in_place_is_checked_before_it_serves(root: Path, spot_onnx: MakeOnnx) -> None:
    repository = Repository(root, check=ChildCheck())
    repository.refresh()
    before = repository.get("pinhole")
    path = root / "pinhole" / "1" / "model.onnx"
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    assert _events(repository) == {("refused", "pinhole", 1)}
    assert repository.get("pinhole") is before
    path.write_bytes(good)
    os.utime(path, ns=(1, 1))
    assert _events(repository) == {("loaded", "pinhole", 1)}
    assert repository.get("pinhole") is not before


def test_the_child_check_says_why(root: Path) -> None:
    check = ChildCheck()
    check(root / "flat", 1)
    (root / "flat" / "SHA256SUMS").write_text("0" * 64 + "  1/model.onnx\n")
    with pytest.raises(ModelError, match="the file is damaged or was replaced"):
        check(root / "flat", 1)


def test_a_check_that_is_killed_refuses_the_candidate(root: Path) -> None:
    check = ChildCheck()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(check, root / "flat", 1)
        while not waiting.done():
            check.stop()
        assert isinstance(waiting.exception(), CheckNotDone)
        assert "its check was killed from outside" in str(waiting.exception())


def test_a_check_that_cannot_be_started_refuses_the_candidate(root: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        with pytest.raises(ModelError, match="its check could not be started: Too many open files"):
            ChildCheck()(root / "flat", 1)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_check_that_was_not_done_is_tried_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, checked = [0.0], list[float]()
    monkeypatch.setattr("curio_serve.models.repository.time.monotonic", lambda: clock[0])

    def check(folder: Path, version: int) -> None:
        if folder.name == "flat":
            checked.append(clock[0])
            if len(checked) < 4:
                raise CheckNotDone("no memory")

    repository = Repository(root, check=check)
    for second in range(60):
        clock[0] = float(second)
        repository.refresh()
    assert checked == [0, 5, 15, 35], "after ever longer pauses, and no more once it loaded"
    assert repository.get("flat").version == 1


def test_a_check_runs_no_file_of_the_working_folder(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "copy.py").write_text("raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    ChildCheck()(root / "flat", 1)


def test_a_reliability_that_is_listed_and_missing_is_refused(root: Path) -> None:
    with (root / "flat" / "SHA256SUMS").open("a") as sums:
        sums.write("0" * 64 + "  1/reliability.json\n")
    repository = Repository(root)
    (refused,) = [change for change in repository.refresh() if change.event == "refused"]
    assert "reliability.json is missing, and SHA256SUMS lists it" in refused.reason


def test_many_replacements(root: Path, spot_onnx: MakeOnnx, write_folder: WriteFolder) -> None:
    repository = Repository(root, num_versions=1)
    repository.refresh()
    for version in range(2, 52):
        write_folder(root / "flat", spot_onnx(False), version)
        shutil.rmtree(root / "flat" / str(version - 1))
        repository.refresh()
        assert repository.get("flat").version == version
