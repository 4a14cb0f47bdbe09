"""``curio-export --int8``: smaller, told on the card, and refused where it costs accuracy."""

import io
import shutil
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from curio_serve.errors import ModelError
from curio_serve.models.model_folder import load_version
from curio_train.commands import export as export_command
from curio_train.errors import ExportError
from curio_train.evaluation import int8 as reduction
from curio_train.evaluation.scores import accuracy
from curio_train.export import int8, write_model
from curio_train.export.graph import Graph
from curio_train.export.onnx import put_spec, to_onnx
from curio_train.export.write_model import Exported, export
from curio_train.exported_model import ExportedModel
from curio_train.scene_code import TRANSLATION
from curio_train.worlds.generated.circles import Circles


@pytest.fixture(autouse=True, scope="module")
def _few_images() -> Iterator[None]:
    """8 images to calibrate with and 50 to judge by instead of 64 and 500."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reduction, "NUM_CALIBRATION", 8)
        patch.setattr(reduction, "NUM_HELD_OUT", 50)
        yield


@pytest.fixture(scope="module")
def reduced(
    circles_run: Path,
    circles_models: tuple[Exported, Exported],
    cache: Path,
    tmp_path_factory: pytest.TempPathFactory,
    _few_images: None,
) -> tuple[Path, str]:
    """The models with version 3 in int8 and 4 with all else as half, and what the command said of version 3."""
    models = Path(shutil.copytree(circles_models[0].path.parents[1], tmp_path_factory.mktemp("int8") / "models"))
    told = []
    for half in ([], ["--half"]):
        with pytest.raises(SystemExit) as exit_, redirect_stdout(io.StringIO()) as out:
            export_command.export([str(circles_run), "--out", str(models), "--int8", *half, "--cache", str(cache)])
        assert not exit_.value.code
        told.append(out.getvalue())
    return models, told[0]


@pytest.fixture
def models(circles_models: tuple[Exported, Exported], tmp_path: Path) -> Path:
    return Path(shutil.copytree(circles_models[0].path.parents[1], tmp_path / "models"))


def test_a_version_in_int8(reduced: tuple[Path, str]) -> None:
    models, said = reduced
    path = models / "circles" / "3"
    size, float_size = ((models / "circles" / n / "model.onnx").stat().st_size for n in ("3", "1"))
    assert size < 0.5 * float_size
    types = {node.op_type for node in onnx.load(path / "model.onnx").graph.node}
    assert {"QuantizeLinear", "DequantizeLinear"} <= types
    told = "accuracy on 50 held-out renderings 0.0% in int8, 0.0% in float32"
    assert told in said
    assert f"| weights | int8 convolutions, else float32; {told} |" in (models / "circles" / "CARD.md").read_text()

    served = load_version(models / "circles", 3)
    assert served.spec.world == "circles"
    original = load_version(models / "circles", 1)
    images = np.random.default_rng(0).integers(0, 256, (4, 128, 128, 3), dtype=np.uint8)
    off = np.abs(served.run(images)[TRANSLATION] - original.run(images)[TRANSLATION]).max()
    assert 0 < off < 0.05
    assert 1e-6 < served.spec.parity_max_abs_error < 0.05


def test_a_version_in_int8_that_computes_something_else_is_refused(reduced: tuple[Path, str], tmp_path: Path) -> None:
    """By more than rounding, though by less than its answers differ from those in float32."""
    folder = Path(shutil.copytree(reduced[0] / "circles", tmp_path / "circles"))
    (folder / "SHA256SUMS").unlink()
    spec, model = load_version(folder, 3).spec, onnx.load(folder / "3" / "model.onnx")
    spec.parity_max_abs_error = 1.0
    put_spec(model, spec)
    onnx.save(model, folder / "3" / "model.onnx")
    assert load_version(folder, 3).version == 3
    golden = dict(np.load(folder / "3" / "golden.npz"))
    np.savez(folder / "3" / "golden.npz", **golden | {TRANSLATION: golden[TRANSLATION] + 0.002})
    with pytest.raises(ModelError, match=r"translation_m is 0\.002 off"):
        load_version(folder, 3)


def test_what_costs_more_than_a_point_is_refused_with_both_figures(
    circles_run: Path, models: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network has learned nothing, so an accuracy that falls is made by demanding that it rises."""
    monkeypatch.setattr(reduction, "LARGEST_LOSS", -0.01)
    before = sorted(models.rglob("*"))
    words = r"in int8, 0\.0% in float32: int8 costs more than -1 point; nothing was written\. Export without --int8"
    with pytest.raises(ExportError, match=words):
        export(circles_run, models, reduce=reduction.int8(cache, half=False))
    assert sorted(models.rglob("*")) == before


def test_what_is_not_quantised_can_be_stored_as_half(reduced: tuple[Path, str]) -> None:
    models, _ = reduced
    graphs = [onnx.load(models / "circles" / number / "model.onnx").graph for number in ("3", "4")]
    assert [any(one.data_type == onnx.TensorProto.FLOAT16 for one in of.initializer) for of in graphs] == [False, True]
    assert "int8 convolutions, else float16" in (models / "circles" / "CARD.md").read_text()
    images = np.random.default_rng(0).integers(0, 256, (4, 128, 128, 3), dtype=np.uint8)
    answers = [load_version(models / "circles", number).run(images)[TRANSLATION] for number in (3, 4)]
    assert 0 < np.abs(answers[1] - answers[0]).max() < 0.05


class _Linear(torch.nn.Module):
    """A network without an activation."""

    def __init__(self) -> None:
        super().__init__()
        self.cells = torch.nn.Conv2d(3, 3, 3)

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        return {TRANSLATION: self.cells(images).mean(dim=(2, 3))[:, None]}


def test_a_network_without_anything_to_quantise_is_refused() -> None:
    model = to_onnx(Graph(_Linear(), Circles()), 128, 128, [TRANSLATION])
    with pytest.raises(ExportError, match="no convolution of 256 or more products before an activation"):
        int8.to_int8(model, torch.zeros(2, 3, 128, 128, dtype=torch.uint8))


@pytest.mark.parametrize(("off", "expected"), [(0.0, 1.0), (0.019, 1.0), (0.021, 0.75), (1.0, 0.75)])
def test_accuracy_is_the_share_within_a_tenth_of_the_diameter(off: float, expected: float) -> None:
    world = Circles()
    true = world.sample(4, (0,))
    predicted = {name: values.clone() for name, values in true.items()}
    predicted[TRANSLATION][0, 0, 0] += off
    assert accuracy(world, predicted, true) == expected


def test_stored_answers_do_not_hang_on_how_float32_is_rounded(
    circles_run: Path, models: Path, reduced: tuple[Path, str], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pixels become 0 to 1 in float32 before they are quantised, so their last digits can move whole steps."""
    path = reduced[0] / "circles" / "3"
    golden = np.load(path / "golden.npz")
    stored = golden[TRANSLATION]
    others = list(int8.rounded_otherwise(onnx.load(path / "model.onnx")))
    assert len(others) == 6
    for other in others:
        found = ExportedModel(other.SerializeToString(), "rounded otherwise")(torch.from_numpy(golden["image"][None]))
        assert np.nanmax(np.abs(found[TRANSLATION][0].numpy() - stored)) <= 5e-4

    monkeypatch.setattr(write_model, "_LARGEST_STEP", 1e-5)  # the network has learned nothing, and says hardly anything
    monkeypatch.setattr(int8, "_ROUNDING", (-1.0,))  # all that is quantised is 0
    with pytest.raises(ExportError, match="every answer to check images hangs on rounding"):
        export(circles_run, models, reduce=reduction.int8(cache, half=False))
