"""The bare loop behind grpcio's own threaded server: what gRPC in Python costs before a server adds anything.

    python plain_server.py MODEL_FOLDER NUM_THREADS

Reads the frame out of the message, runs the bare loop on it, answers 300 bytes that are always the same. Prints its
port and serves until it is ended.
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
from curio_proto.v1.detector_pb2 import DetectRequest

sys.path.insert(0, str(Path(__file__).parents[1]))

from load.generator import bare_loop

_ANSWER = bytes(300)  # about as long as ours for one object


class _Handlers(grpc.GenericRpcHandler):
    def __init__(self, handler: grpc.RpcMethodHandler) -> None:
        self._handler = handler

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler:
        return self._handler


def main() -> None:
    """Serves until the process is ended."""
    folder, num_threads = sys.argv[1:]
    one = bare_loop(Path(folder))

    def answer(data: bytes, _context: grpc.ServicerContext) -> bytes:
        one(DetectRequest.FromString(data).encoded)
        return _ANSWER

    server = grpc.server(ThreadPoolExecutor(int(num_threads)))
    server.add_generic_rpc_handlers((_Handlers(grpc.unary_unary_rpc_method_handler(answer)),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    print(port, flush=True)
    server.wait_for_termination()


if __name__ == "__main__":
    main()
