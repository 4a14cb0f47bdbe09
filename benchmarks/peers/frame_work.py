"""What every server of the comparison does with a frame: the bare loop's decoding, warp and session, and no more.

Runs in the peers' environments, so it imports what those have: numpy, OpenCV, onnxruntime.
"""

import os

import cv2
import numpy as np

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when onnxruntime is imported
import onnxruntime

INPUT = "image"


class FrameWork:
    """JPEG in, position out; one thread a call, safe to share between threads.

    Args:
        model: Path of the ONNX file.
        view_from_reduced: Homography [3, 3] from the reduced frame's pixels to the network's, row after row.
    """

    def __init__(self, model: str, view_from_reduced: list[float]) -> None:
        cv2.setNumThreads(1)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        shape = self._session.get_inputs()[0].shape
        self._size = (shape[2], shape[1])
        self._homography = np.reshape(view_from_reduced, (3, 3))

    def __call__(self, jpeg: bytes) -> np.ndarray:
        """Position in metres, float32 [3], of what the network sees in one frame."""
        # By 4: the most that leaves a 640x480 frame more pixels than the network's 128.
        reduced = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_REDUCED_COLOR_4)
        rgb = cv2.cvtColor(reduced, cv2.COLOR_BGR2RGB)
        view = cv2.warpPerspective(
            rgb, self._homography, self._size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        outputs = self._session.run(["translation_m"], {INPUT: view[None]})
        return outputs[0][0, 0]
