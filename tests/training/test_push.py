"""What curio-export --push does beside asking a hub, which tests/end_to_end/hub does."""

import socket
from pathlib import Path

import pytest
from curio_train.commands import export

APE = Path(__file__).parents[2] / "models" / "ape"


def test_a_model_that_could_not_be_pushed_is_kept(
    circles_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{closed.getsockname()[1]}")
    with pytest.raises(SystemExit, match="1"):
        export.export([str(circles_run), "--out", str(tmp_path), "--push", "acme/circles", "--license", "mit"])
    told = " ".join(capsys.readouterr().err.split())
    assert "the hub does not answer" in told
    assert f"to push it again: curio-export {tmp_path}/circles --push acme/circles --license mit" in told
    assert (tmp_path / "circles" / "1" / "model.onnx").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--push", "circles"], "expected ORG/NAME"),
        (["--license", "mit"], "give it together with --push"),
        (["--push", "acme/circles", "--half"], "is a model and pushed as it is"),
    ],
)
def test_flags_that_do_not_belong_together_are_refused(
    flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        export.export([str(APE), *flags])
    assert said in " ".join(capsys.readouterr().err.split())
