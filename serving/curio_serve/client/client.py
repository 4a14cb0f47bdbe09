"""Clients for the pose service, blocking and asynchronous.

    with PoseClient("127.0.0.1:8500") as client:
        answer = client.detect("ape", "frame.jpg", camera="camera.json")

Every call has a deadline. Detection changes nothing on the server, so a client tries a call again, within its deadline,
if the server was out of reach, or if its queue was full and it said when to come back. Failures come back as the
exceptions that the server raised (:mod:`curio_serve.errors`).
"""

import asyncio
import time
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import grpc
import numpy as np
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub

from curio_serve.client.request import CameraLike, ImageLike, RegionLike, detect_request, selector, views_request
from curio_serve.client.retries import Attempts, deadline_s, error_from_call
from curio_serve.deferred import DeferredError
from curio_serve.errors import UsageError
from curio_serve.files import read_given
from curio_serve.planes.plane import AnyPlane

# Connect again soon after a server was replaced; gRPC's own first pause is a second.
_CHANNEL_OPTIONS = (("grpc.initial_reconnect_backoff_ms", 100), ("grpc.max_reconnect_backoff_ms", 2000))


@dataclass(frozen=True)
class Tls:
    """Files (PEM) for an encrypted connection."""

    root_certificates: Path | None = None
    """Authorities that may have signed the server's certificate; None: the system's."""
    certificate: Path | None = None
    """The client's own certificate, if the server asks for one."""
    private_key: Path | None = None
    """Key of the client's certificate."""

    def credentials(self) -> grpc.ChannelCredentials:
        """Credentials for gRPC from the files.

        Raises:
            UsageError: One cannot be read, or certificate and key do not come together.
        """
        if (self.certificate is None) != (self.private_key is None):
            raise UsageError("a client certificate and its private key belong together; one of them is missing")
        roots, key, chain = (_read(path) for path in (self.root_certificates, self.private_key, self.certificate))
        return grpc.ssl_channel_credentials(roots, key, chain)


class _Client:
    """The part that both clients share: the channel to the server, deadlines and credentials."""

    _grpc: ClassVar[Any] = grpc
    """The functions that open a channel: gRPC's blocking or its asynchronous ones."""

    def __init__(
        self, address: str, *, timeout_s: float = 10.0, max_attempts: int = 5, tls: Tls | None = None, token: str = ""
    ) -> None:
        """Prepare a connection; the first call makes it.

        Args:
            address: ``host:port``.
            timeout_s: Deadline of a call, all its attempts together, if the call names no other.
            max_attempts: Largest number of attempts a call.
            tls: Encrypts the connection; None: plain, for servers on the loopback.
            token: Bearer token, if the server asks for one.

        Raises:
            UsageError: An argument is of another kind.
        """
        for name, value, kind in (
            ("address", address, str),
            ("token", token, str),
            ("max_attempts", max_attempts, int),
        ):
            if not isinstance(value, kind) or (name == "address" and not value):
                raise UsageError(f"{name} {value!r}: expected {'a number' if kind is int else 'text'}")
        deadline_s(timeout_s)
        self.address = address
        self._timeout_s, self._is_closed = timeout_s, False
        self._max_attempts = max_attempts
        token = token.strip()  # files end with a line feed
        if not (token.isascii() and (token.isprintable())):
            raise UsageError("token: expected printable ASCII text in one line, as in the server's --token-file")
        self._metadata = (("authorization", f"Bearer {token}"),) if token else ()
        if tls is None:
            self._channel = self._grpc.insecure_channel(address, _CHANNEL_OPTIONS)
        else:
            self._channel = self._grpc.secure_channel(address, tls.credentials(), _CHANNEL_OPTIONS)
        self._stub = PoseDetectorStub(self._channel)

    def _refuse_closed(self) -> None:
        if self._is_closed:
            raise UsageError("the client is closed; make a new one")

    def _attempts(self, timeout_s: float | None) -> Attempts:
        return Attempts(self.address, self._timeout_s if timeout_s is None else timeout_s, self._max_attempts)


class PoseClient(_Client):
    """Blocking client; safe to share between threads."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection and every call in flight."""
        self._is_closed = True
        self._channel.close()

    def detect(
        self,
        model: str | Iterable[str],
        image: ImageLike,
        camera: CameraLike = None,
        *,
        objects: Iterable[str] = (),
        regions: Iterable[RegionLike] = (),
        min_confidence: float | None = None,
        max_detections: int | None = None,
        max_instances: int | None = None,
        reads: int | None = None,
        plane: AnyPlane | None = None,
        apply_exif_rotation: bool = False,
        color: Literal["rgb", "bgr"] = "rgb",
        request_id: str = "",
        timeout_s: float | None = None,
    ) -> messages.DetectResponse:
        """Poses in one image, within ``timeout_s``; other arguments are those of :func:`detect_request`.

        Raises:
            CurioError: The server raised it, or is out of reach.
        """
        request = detect_request(
            model,
            image,
            camera,
            objects=objects,
            regions=regions,
            min_confidence=min_confidence,
            max_detections=max_detections,
            max_instances=max_instances,
            reads=reads,
            plane=plane,
            apply_exif_rotation=apply_exif_rotation,
            color=color,
            request_id=request_id,
        )
        return self._call(self._stub.Detect, request, timeout_s)

    def detect_views(
        self,
        model: str | Iterable[str],
        views: Iterable[tuple[ImageLike, CameraLike, np.ndarray]],
        *,
        timeout_s: float | None = None,
        **options: Any,
    ) -> messages.DetectResponse:
        """Poses in the frame of a rig; arguments are those of :func:`~curio_serve.client.request.views_request`."""
        return self._call(self._stub.Detect, views_request(model, views, **options), timeout_s)

    def detect_stream(
        self, requests: Iterable[messages.DetectRequest], *, timeout_s: float
    ) -> Iterator[messages.DetectResponse]:
        """Answers in the order of the requests (see :func:`detect_request`), over one connection; never repeated.

        A frame that could not be answered has an answer without results, whose `error` says why
        (:func:`error_from_answer`); the stream goes on.

        Args:
            requests: May be endless; sent as the server takes them.
            timeout_s: Deadline of the whole stream; ``math.inf``: none.

        Raises:
            CurioError: The stream as a whole failed, or the server is out of reach.
            Exception: What the iterable raised, after the answers to the requests before it.
        """
        self._refuse_closed()
        failed = DeferredError()  # gRPC would call it an unknown error, and drop answers
        call = self._stub.DetectStream(failed.each(requests), timeout=deadline_s(timeout_s), metadata=self._metadata)
        try:
            yield from call
        except grpc.RpcError as exc:
            raise error_from_call(exc, self.address) from exc
        finally:
            call.cancel()  # the caller may have stopped listening early
        failed.raise_it()

    def list_models(self, *, timeout_s: float | None = None) -> list[messages.ModelInfo]:
        """The models that the server has loaded."""
        return list(self._call(self._stub.ListModels, messages.ListModelsRequest(), timeout_s).models)

    def get_model(self, model: str, *, timeout_s: float | None = None) -> messages.GetModelResponse:
        """Specification and version of a model, ``name`` (the latest) or ``name/version``."""
        return self._call(self._stub.GetModel, messages.GetModelRequest(model=selector(model)), timeout_s)

    def _call(self, method: Any, request: Any, timeout_s: float | None) -> Any:
        attempts = self._attempts(timeout_s)
        while True:
            self._refuse_closed()
            try:
                return method(request, timeout=attempts.remaining_s, metadata=self._metadata)
            except grpc.RpcError as exc:
                pause_s = attempts.pause_after(exc)
            time.sleep(pause_s)


class AsyncPoseClient(_Client):
    """Client for asyncio; arguments and errors are those of :class:`PoseClient`.

    It belongs to the event loop in which it is made: make it within a coroutine, and another one for another loop.
    """

    _grpc: ClassVar[Any] = grpc.aio

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection and every call in flight."""
        self._is_closed = True
        await self._channel.close()

    async def detect(
        self,
        model: str | Iterable[str],
        image: ImageLike,
        camera: CameraLike = None,
        *,
        timeout_s: float | None = None,
        **options: Any,
    ) -> messages.DetectResponse:
        """Poses in one image; ``options`` are the keyword arguments of :meth:`PoseClient.detect`."""
        return await self._call(self._stub.Detect, detect_request(model, image, camera, **options), timeout_s)

    async def detect_views(
        self,
        model: str | Iterable[str],
        views: Iterable[tuple[ImageLike, CameraLike, np.ndarray]],
        *,
        timeout_s: float | None = None,
        **options: Any,
    ) -> messages.DetectResponse:
        """Poses in the frame of a rig; see :meth:`PoseClient.detect_views`."""
        return await self._call(self._stub.Detect, views_request(model, views, **options), timeout_s)

    async def detect_stream(
        self, requests: AsyncIterable[messages.DetectRequest], *, timeout_s: float
    ) -> AsyncIterator[messages.DetectResponse]:
        """Answers in the order of the requests; see :meth:`PoseClient.detect_stream`."""
        self._refuse_closed()
        failed = DeferredError()  # gRPC would call it an unknown error, and drop answers
        call = self._stub.DetectStream(
            failed.each_async(requests), timeout=deadline_s(timeout_s), metadata=self._metadata
        )
        try:
            async for answer in call:
                yield answer
        except grpc.RpcError as exc:
            raise error_from_call(exc, self.address) from exc
        finally:
            call.cancel()
        failed.raise_it()

    async def list_models(self, *, timeout_s: float | None = None) -> list[messages.ModelInfo]:
        """The models that the server has loaded."""
        return list((await self._call(self._stub.ListModels, messages.ListModelsRequest(), timeout_s)).models)

    async def get_model(self, model: str, *, timeout_s: float | None = None) -> messages.GetModelResponse:
        """Specification and version of a model, ``name`` (the latest) or ``name/version``."""
        return await self._call(self._stub.GetModel, messages.GetModelRequest(model=selector(model)), timeout_s)

    async def _call(self, method: Any, request: Any, timeout_s: float | None) -> Any:
        attempts = self._attempts(timeout_s)
        while True:
            self._refuse_closed()
            try:
                return await method(request, timeout=attempts.remaining_s, metadata=self._metadata)
            except grpc.RpcError as exc:
                pause_s = attempts.pause_after(exc)
            await asyncio.sleep(pause_s)


def _read(path: Path | None) -> bytes | None:
    if path is None:
        return None
    try:
        content = read_given(path)
    except OSError as exc:
        raise UsageError(f"{path}: cannot be read: {exc.strerror}") from exc
    if b"-----BEGIN " not in content:
        raise UsageError(f"{path}: expected a PEM file, which begins with -----BEGIN")
    return content
