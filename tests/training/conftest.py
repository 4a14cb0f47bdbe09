"""Run folders for what comes after training, and a two-stage network at a brick."""

import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.config import RunConfig, WorldOptions
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.photographs import UnlabelledPhotographs
from curio_train.evaluation import evaluate
from curio_train.evaluation.reporting import report
from curio_train.export import graph
from curio_train.export.write_model import Exported, export
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.provenance import record_session
from curio_train.learning.state import TrainingProgress, TrainState
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box
from curio_train.meshes.symmetries import Symmetries, find_symmetries
from curio_train.networks import outline_alignment
from curio_train.networks.templates import geometry
from curio_train.worlds import build, image_sets
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.options import CirclesOptions
from curio_train.worlds.single_object import confidence
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object


@pytest.fixture(autouse=True, scope="session")
def _symmetries_found_once() -> Iterator[None]:
    """The symmetries of a shape are searched once, which takes seconds; test_symmetries.py asks the search itself."""
    known: dict[tuple[bytes, bytes], Symmetries] = {}

    def find(mesh: Mesh) -> Symmetries:
        shape = (mesh.vertices_m.tobytes(), mesh.faces.tobytes())
        if shape not in known:
            known[shape] = find_symmetries(mesh)
        return known[shape]

    with pytest.MonkeyPatch.context() as patch:
        for module in ("worlds.capture", "worlds.tabletop.files", "doctor.mesh_file", "doctor.examine"):
            patch.setattr(f"curio_train.{module}.find_symmetries", find)
        yield


@pytest.fixture(scope="session")
def write_run() -> Callable[..., Path]:
    """``write_run(path, options=…, spread=…)``: a run as training leaves it, its network drawn at random."""

    def write(path: Path, options: WorldOptions | None = None, spread: float = 1.0) -> Path:
        config = RunConfig(options or CirclesOptions(), method="noncur", seed=3, images=64)
        run = RunFolder(path, config)
        run.write_config(new=True)
        record_session(path)
        state = TrainState(config, build(config.world), torch.device("cpu"))
        generator = torch.Generator().manual_seed(1)
        for module in state.pose.network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):  # statistics that folding must not lose
                module.running_mean.normal_(0, 0.1, generator=generator)
                module.running_var.uniform_(0.2, 2.0, generator=generator)
                module.weight.data.uniform_(0.5, 2.0, generator=generator)
        for branch in state.pose.network.heads.branches.values():
            branch[-1].weight.data *= spread
        state.progress = TrainingProgress(step=2, images=64, seconds=1.5)
        run.save(state)
        return path

    return write


@pytest.fixture(scope="session")
def circles_run(tmp_path_factory: pytest.TempPathFactory, write_run: Callable[..., Path]) -> Path:
    """A run of circles; copy it before you change it."""
    return write_run(tmp_path_factory.mktemp("runs") / "circles")


@pytest.fixture(scope="session")
def circles_models(tmp_path_factory: pytest.TempPathFactory, circles_run: Path) -> tuple[Exported, Exported]:
    """That run exported in float32 (version 1) and in float16 (version 2); copy the folder before you change it."""
    models = tmp_path_factory.mktemp("out") / "models"
    return export(circles_run, models), export(circles_run, models, half=True)


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Image sets that many tests read and none changes; the first draws them, which takes ten seconds."""
    return tmp_path_factory.mktemp("cache")


@contextmanager
def _largest_file(num_bytes: int) -> Iterator[None]:
    """A disk with room for so much: beyond it every write fails, as on a full one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


@pytest.fixture
def largest_file() -> Callable[[int], AbstractContextManager[None]]:
    """``with largest_file(num_bytes):`` a disk with room for so much in a file."""
    return _largest_file


@pytest.fixture
def small_image_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stored image sets of 100 and 50 images instead of 2,000 and 500, which take ten seconds to draw."""
    monkeypatch.setattr(image_sets, "NUM_IMAGES", {"train": 100, "validation": 50, "test": 50})


@pytest.fixture
def small_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes after training, in small, because whole frames take long to render and to read.

    Calibration on 5 frames instead of 300; outlines of 24 views instead of 220; 2 images of a kind and 2 rounds of
    jitter in the check of numerical stability instead of 4 and 8; evaluation in batches of 5 and on 5 empty frames; 6
    images and 3 photographs in reports; and one round of the alignment with outlines instead of 4, which take long to
    trace.
    """
    monkeypatch.setattr(confidence, "NUM_FRAMES", 5)
    monkeypatch.setattr(confidence, "_BATCH_SIZE", 5)
    monkeypatch.setattr(geometry, "NUM_VIEWS", 24)
    monkeypatch.setattr(graph, "_NUM_CHECK_IMAGES", 2)
    monkeypatch.setattr(graph, "NUM_JITTERED", 2)
    monkeypatch.setattr(evaluate, "_BATCH_SIZE", 5)
    monkeypatch.setattr(evaluate, "_NUM_EMPTY", 5)
    monkeypatch.setattr(report, "_NUM_COMPARED", 6)
    monkeypatch.setattr(report, "_NUM_PHOTOGRAPHS", 3)
    monkeypatch.setattr(outline_alignment, "_REACHES_PX", (4.0,))


class _Greys:
    """Photographs of one grey each, darker to brighter, that nothing learns from."""

    def __init__(self, folder: Path, count: int) -> None:
        self._paths = [folder / f"{number:02}.png" for number in range(count)]
        for number, path in enumerate(self._paths):
            cv2.imwrite(str(path), np.full((480, 640, 3), 9 * number, np.uint8))

    def paths(self) -> Sequence[Path]:
        return self._paths

    def unlabelled_paths(self) -> Sequence[Path]:
        return []

    def unlabelled(self) -> UnlabelledPhotographs:
        return UnlabelledPhotographs([])


@pytest.fixture
def greys(tmp_path: Path) -> Callable[[int], _Greys]:
    """``greys(count)``: so many photographs of 640x480 pixels; number n has the grey level 9 n."""
    return lambda count: _Greys(tmp_path, count)


@pytest.fixture(scope="session")
def brick() -> Object:
    """Something that looks alike after half a turn, somewhere before a grey wall."""
    mesh = box((0.09, 0.06, 0.12))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    kind = ObjectKind("brick", (0,), mesh.diameter_m, mesh.box_corners_m, mesh.sha256, symmetries=(half_turn,))
    camera = Intrinsics(np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]]), 640, 480)
    pool = np.full((5, 240, 320, 3), 128, np.uint8)
    return Object(kind, mesh, camera, 0.5, 1.5, lambda _: ClutterBackgrounds(pool))


@pytest.fixture(scope="session")
def brick_world(brick: Object) -> TwoStageWorld:
    """The two stages at it."""
    return TwoStageWorld("linemod", brick)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Torch computes in one thread: sums over several have no fixed order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
