"""One tiny real run, made by the installed commands, that all of these tests look at."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.worlds.generated.circles import Circles

NUM_FRAMES = 12
Call = Callable[..., "subprocess.CompletedProcess[str]"]


def _command(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def _environment(extra: Mapping[str, str] | None) -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"} | dict(extra or {})


@pytest.fixture(scope="session")
def call() -> Call:
    """``call(name, *arguments, status=0, extra=None)``: an installed command, run to its end."""

    def run(
        name: str, *arguments: str | Path, status: int = 0, extra: Mapping[str, str] | None = None
    ) -> "subprocess.CompletedProcess[str]":
        line = [_command(name), *map(str, arguments)]
        done = subprocess.run(line, env=_environment(extra), capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stderr
        assert "Traceback" not in done.stderr
        return done

    return run


@pytest.fixture(scope="session")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Iterator[str]]:
    """``with serving(models, extra=None) as address``: a real server; SIGTERM has to end it with status 0."""

    @contextmanager
    def serve(models: Path, extra: Mapping[str, str] | None = None) -> Iterator[str]:
        log = tmp_path_factory.mktemp("server") / "log"
        line = [_command("curio-serve"), str(models), "--port", "0"]
        with log.open("w") as stderr:
            process = subprocess.Popen(line, env=_environment(extra), stdout=subprocess.PIPE, stderr=stderr, text=True)
        assert process.stdout is not None
        try:
            said = process.stdout.readline()
            assert said.startswith("listening on 127.0.0.1:"), log.read_text()
            yield said.split()[-1]
        finally:
            process.send_signal(signal.SIGTERM)
            status = process.wait(timeout=60)
            process.stdout.close()
        assert status == 0, log.read_text()

    return serve


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory, call: Call) -> Path:
    """Ten steps of learning from images alone."""
    folder = tmp_path_factory.mktemp("train")
    flags = ["--method", "noncur", "--images", "640", "--cache", folder / "cache", "--out", folder / "run"]
    done = call("curio-train", "circles", *flags)
    assert "the budget is spent after 640 images" in done.stdout
    return folder / "run"


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory, run: Path, call: Call) -> Path:
    """The repository with the run's model, ``circles``, version 1."""
    folder = tmp_path_factory.mktemp("export") / "models"
    done = call("curio-export", run, "--out", folder)
    assert done.stdout.startswith(f"{folder / 'circles' / '1'}: 8.1 MB")
    return folder


@pytest.fixture(scope="session")
def images() -> torch.Tensor:
    """uint8 [num_frames, 3, 128, 128]: circles that training has not seen."""
    world = Circles()
    rendered = world.render(world.sample(NUM_FRAMES, (99,)))
    return (rendered.clamp(0, 1) * 255).round().byte()


@pytest.fixture(scope="session")
def frames(tmp_path_factory: pytest.TempPathFactory, images: torch.Tensor) -> list[Path]:
    """The images as PNG files."""
    folder = tmp_path_factory.mktemp("frames")
    paths = [folder / f"{number:02d}.png" for number in range(len(images))]
    for path, image in zip(paths, images.permute(0, 2, 3, 1).numpy(), strict=True):
        assert cv2.imwrite(str(path), cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR))
    return paths
