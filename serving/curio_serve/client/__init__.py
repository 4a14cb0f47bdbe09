"""A client for the pose service, blocking and asynchronous."""

from curio_serve.client.client import AsyncPoseClient, PoseClient, Tls
from curio_serve.client.request import detect_request
from curio_serve.client.retries import error_from_answer
from curio_serve.planes.plane import Plane

__all__ = ["AsyncPoseClient", "Plane", "PoseClient", "Tls", "detect_request", "error_from_answer"]
