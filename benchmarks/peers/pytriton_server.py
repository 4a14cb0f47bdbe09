"""The frame work behind Triton, by pytriton: ``python pytriton_server.py MODEL PORT NUM_WORKERS HOMOGRAPHY...``."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from frame_work import FrameWork
from pytriton.decorators import batch
from pytriton.model_config import ModelConfig, Tensor
from pytriton.triton import Triton, TritonConfig


def main() -> None:
    """Serves until the process is ended."""
    model, port, num_workers, *homography = sys.argv[1:]

    work = FrameWork(model, [float(value) for value in homography])
    pool = ThreadPoolExecutor(int(num_workers))

    # One instance that works on a batch's frames at the same time: a second one waits a second at most for the first
    # to import, and fails where that takes longer.
    @batch
    def infer(image: np.ndarray) -> dict[str, np.ndarray]:
        return {"translation_m": np.stack(list(pool.map(work, image[:, 0])))}

    config = TritonConfig(
        grpc_address="127.0.0.1",
        grpc_port=int(port),
        http_address="127.0.0.1",
        http_port=int(port) + 1,
        allow_metrics=False,
    )
    with Triton(config=config) as triton:
        triton.bind(
            model_name="paper",
            infer_func=infer,
            inputs=[Tensor(name="image", dtype=bytes, shape=(1,))],
            outputs=[Tensor(name="translation_m", dtype=np.float32, shape=(3,))],
            config=ModelConfig(max_batch_size=8),
        )
        triton.serve()


if __name__ == "__main__":
    main()
