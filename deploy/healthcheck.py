"""Ask a server on this machine whether it serves: exit status 0 yes, 1 no. ``python healthcheck.py [PORT]``.

Without a port it is that of the variable CURIO_SERVE_PORT, or 8500.
"""

import os
import sys

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc


def main() -> int:
    """Exit status."""
    port = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("CURIO_SERVE_PORT", "8500")
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        try:
            answer = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=2)
        except grpc.RpcError as exc:
            print(f"no answer on port {port}: {exc.details()}", file=sys.stderr)
            return 1
    return 0 if answer.status == health_pb2.HealthCheckResponse.SERVING else 1


if __name__ == "__main__":
    sys.exit(main())
