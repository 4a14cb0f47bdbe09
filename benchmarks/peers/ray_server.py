"""The frame work behind Ray Serve's gRPC ingress: ``python ray_server.py MODEL PORT NUM_WORKERS HOMOGRAPHY...``.

The service is our own ``PoseDetector``, so ``curio_proto`` has to be importable; the same client talks to both.
"""

import signal
import sys
import threading

import ray
from curio_proto.v1.detector_pb2 import DetectRequest, DetectResponse
from frame_work import FrameWork
from ray import serve
from ray.serve.config import HTTPOptions, gRPCOptions


@serve.deployment
class PoseDetector:
    """One replica."""

    def __init__(self, model: str, homography: list[float]) -> None:
        self._work = FrameWork(model, homography)

    def Detect(self, request: DetectRequest) -> DetectResponse:
        """Answers one frame."""
        answer = DetectResponse()
        detection = answer.results.add().detections.add()
        detection.translation_m.extend(self._work(request.encoded).tolist())
        return answer


def main() -> None:
    """Serves until SIGTERM."""
    model, port, num_workers, *homography = sys.argv[1:]
    ray.init(num_cpus=int(num_workers), include_dashboard=False, logging_level="warning")
    serve.start(
        logging_config={"enable_access_log": False},
        http_options=HTTPOptions(location="HeadOnly", host="127.0.0.1", port=int(port) + 1),
        grpc_options=gRPCOptions(
            port=int(port),
            grpc_servicer_functions=["curio_proto.v1.detector_pb2_grpc.add_PoseDetectorServicer_to_server"],
        ),
    )
    options = {"num_replicas": int(num_workers), "ray_actor_options": {"num_cpus": 1}, "max_ongoing_requests": 8}
    serve.run(PoseDetector.options(**options).bind(model, [float(value) for value in homography]), name="paper")
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    ended.wait()
    serve.shutdown()
    ray.shutdown()


if __name__ == "__main__":
    main()
