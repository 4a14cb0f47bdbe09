"""Writes the messages in tests/serving/corpus: each has been a way to hurt a server, and shall be refused.

    python benchmarks/load/fuzz_corpus.py

A message that the fuzz tests find joins them here, by how it is made; a small one may be written down byte by byte.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from curio_proto.inference.inference_pb2 import ModelInferRequest
from curio_proto.v1.detector_pb2 import PIXEL_FORMAT_GRAY8, Camera, DetectRequest, ModelSelector, RawImage, Region

_FOLDER = Path(__file__).parents[2] / "tests" / "serving" / "corpus"
_FLAT, _PINHOLE = ModelSelector(name="flat"), ModelSelector(name="pinhole")
_GRAY = RawImage(format=PIXEL_FORMAT_GRAY8, width=16, height=16, data=bytes(256))
_IMAGE = ModelInferRequest.InferInputTensor(name="image", datatype="UINT8", shape=[1, 64, 96, 3])


def main() -> None:
    """Replaces the corpus."""
    _FOLDER.mkdir(exist_ok=True)
    for old in _FOLDER.glob("*.bin"):
        old.unlink()
    for name, data in _messages():
        (_FOLDER / f"{name}.bin").write_bytes(data)


def _messages() -> Iterator[tuple[str, bytes]]:
    """Name and bytes of each message."""
    for name, request in {**_detect_requests(), **_infer_requests()}.items():
        yield name, request.SerializeToString()
    yield "Detect-no-message", b"\xff" * 50
    yield "Detect-field-longer-than-the-message", b"\x0a\xff\xff\xff\xff\x0f"
    yield "Detect-open-groups", b"\x0b" * 500
    yield "GetModel-length-beyond-the-end", b"\x0a\x05\x0a\xff\xff\xff\xff"


def _detect_requests() -> dict[str, DetectRequest]:
    return {
        "Detect-same-model-16-times": DetectRequest(models=[_FLAT] * 16, raw=_GRAY),
        "Detect-empty-models": DetectRequest(models=[ModelSelector()] * 600, raw=_GRAY),
        "Detect-empty-regions": DetectRequest(models=[_FLAT], raw=_GRAY, regions=[Region()] * 600),
        "Detect-endless-camera-matrix": _with_camera(camera_matrix=[1] * 100),
        "Detect-camera-of-nan": _with_camera(camera_matrix=[float("nan")] * 9),
        "Detect-lens-of-seven-numbers": _with_camera(
            camera_matrix=[300, 0, 8, 0, 300, 8, 0, 0, 1], distortion=[0] * 7
        ),
        "Detect-png-of-four-billion-columns": DetectRequest(models=[_FLAT], encoded=_png(2**32 - 1, 1)),
        "Detect-png-without-pixels": DetectRequest(models=[_FLAT], encoded=_png(64, 64)),
        "Detect-rows-beyond-the-data": DetectRequest(
            models=[_FLAT], raw=RawImage(format=PIXEL_FORMAT_GRAY8, width=16, height=2**32 - 1, stride=2**32 - 1)
        ),
    }  # fmt: skip


def _with_camera(**values: list[float]) -> DetectRequest:
    return DetectRequest(models=[_PINHOLE], raw=_GRAY, camera=Camera(**values))


def _infer_requests() -> dict[str, ModelInferRequest]:
    empty = ModelInferRequest.InferInputTensor()
    name = ModelInferRequest.InferRequestedOutputTensor()
    negative = ModelInferRequest.InferInputTensor(name="image", datatype="UINT8", shape=[-1] * 4)
    return {
        "ModelInfer-empty-inputs": ModelInferRequest(model_name="flat", inputs=[empty] * 600),
        "ModelInfer-empty-outputs": ModelInferRequest(model_name="flat", inputs=[_IMAGE], outputs=[name] * 600),
        "ModelInfer-too-few-bytes": ModelInferRequest(model_name="flat", inputs=[_IMAGE], raw_input_contents=[b"12"]),
        "ModelInfer-negative-shape": ModelInferRequest(model_name="flat", inputs=[negative]),
        "ModelInfer-version-of-twenty-digits": ModelInferRequest(model_name="flat", model_version="9" * 20),
    }  # fmt: skip


def _png(width: int, height: int) -> bytes:
    """A PNG's header without its pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = (head, b"IDAT" + zlib.compress(b""), b"IEND")
    written = (struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(written)


if __name__ == "__main__":
    main()
