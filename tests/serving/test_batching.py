"""Several calls in one run of the network: each gets its own answer, and a run's failure reaches all who were in it."""

import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_serve.errors import InternalError
from curio_serve.models.batching import Batcher
from curio_serve.models.model_folder import load_version
from curio_serve.models.runtime import Runtime


class Network:
    """Doubles numbers; the first run waits until it is let go, so that others gather behind it."""

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.begun, self.may_end = threading.Event(), threading.Event()

    def __call__(self, images: np.ndarray) -> list[np.ndarray]:
        self.sizes.append(len(images))
        self.begun.set()
        assert self.may_end.wait(60)
        if (images < 0).any():
            raise InternalError("negative")
        return [images * 2, images + 1]


def _gather(batcher: Batcher, network: Network, values: list[int]) -> list[object]:
    """Answers or errors of one call a value: the first alone, the others behind it."""

    def ask(value: int) -> object:
        try:
            return [output.tolist() for output in batcher(np.array([value]))]
        except InternalError as exc:
            return str(exc)

    with ThreadPoolExecutor(len(values)) as pool:
        first = pool.submit(ask, values[0])
        assert network.begun.wait(60)
        others = [pool.submit(ask, value) for value in values[1:]]
        while len(batcher._waiting) < len(others):
            assert not first.done()
        network.may_end.set()
        return [call.result() for call in (first, *others)]


def test_calls_that_come_meanwhile_run_together_and_get_their_own() -> None:
    network = Network()
    answers = _gather(Batcher(network, 4), network, list(range(8)))
    assert answers == [[[2 * n], [n + 1]] for n in range(8)]
    assert network.sizes == [1, 4, 3]


def test_a_failed_run_fails_those_in_it_and_no_others() -> None:
    network = Network()
    batcher = Batcher(network, 2)
    answers = _gather(batcher, network, [1, -2, -3, -4, -5])
    assert answers[0] == [[2], [2]]
    assert answers[1:] == ["negative"] * 4
    assert batcher(np.array([7, 8, 9]))[0].tolist() == [14, 16, 18], "more than a batch in one call is run as it is"


def test_a_model_answers_the_same_in_batches(models_dir: Path) -> None:
    alone = load_version(models_dir / "pinhole", 1)
    together = load_version(models_dir / "pinhole", 1, Runtime(max_batch=4))
    images = np.random.default_rng(0).integers(0, 255, (24, 1, 64, 96, 3)).astype(np.uint8)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(together.run, images))
    for image, outputs in zip(images, found, strict=True):
        for name, value in alone.run(image).items():
            np.testing.assert_allclose(outputs[name], value, rtol=1e-5, err_msg=name)


def test_a_server_that_batches(start_server: Callable[..., object], models_dir: Path, tmp_path: Path) -> None:
    import grpc

    root = Path(shutil.copytree(models_dir, tmp_path / "models"))
    server = start_server(root, "--batch", "4", "--workers", "6")
    requests = []
    for number in range(30):
        pixels = np.zeros((64, 96), np.uint8)
        pixels[20:40, 2 * number : 2 * number + 20] = 255
        raw = pb.RawImage(format=pb.PIXEL_FORMAT_GRAY8, width=96, height=64, data=pixels.tobytes())
        requests.append(pb.DetectRequest(models=[pb.ModelSelector(name="flat")], raw=raw))
    with grpc.insecure_channel(server.address) as channel:  # type: ignore[attr-defined]
        stub = PoseDetectorStub(channel)
        answers = [call.result() for call in [stub.Detect.future(request, timeout=60) for request in requests]]
    centres = [answer.results[0].detections[0].translation_m[0] for answer in answers]
    assert centres == pytest.approx([(2 * n + 9.5 - 47.5) / 96 for n in range(30)], abs=1e-5)
