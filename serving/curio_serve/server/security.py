"""Authenticates callers: TLS, client certificates, bearer tokens."""

import hmac
import logging
import ssl
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import grpc
from grpc_health.v1 import health

from curio_serve.api.status import status_from_error
from curio_serve.errors import TokenError, UsageError, status_of
from curio_serve.files import read_given
from curio_serve.server.config import ServeConfig
from curio_serve.telemetry import Metrics, log

_HEALTH_PREFIX = f"/{health.SERVICE_NAME}/"


class Tokens:
    """The bearer tokens that callers may show; none: everybody may call."""

    def __init__(self, known: Sequence[bytes] = ()) -> None:
        self._known = known

    def refuse(self, metadata: Iterable[tuple[str, str | bytes]]) -> TokenError | None:
        """The reason for refusing a call with this metadata; None if it is allowed."""
        if not self._known:
            return None
        shown = dict(metadata).get("authorization", "")
        text = shown.encode() if isinstance(shown, str) else shown
        token = text.removeprefix(b"Bearer ")
        # Every token is compared, in constant time, so that timing reveals nothing.
        matches = [hmac.compare_digest(token, known) for known in self._known]
        if token != text and any(matches):
            return None
        return TokenError("bearer token missing or unknown; send the metadata `authorization: Bearer <token>`")


class TokenInterceptor(grpc.ServerInterceptor):
    """Lets calls pass that show a known bearer token, and health checks."""

    def __init__(self, tokens: Tokens, metrics: Metrics) -> None:
        """Count refused calls in ``metrics``."""
        self._tokens, self._metrics = tokens, metrics

    def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], "grpc.RpcMethodHandler[Any, Any] | None"],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "grpc.RpcMethodHandler[Any, Any] | None":
        if handler_call_details.method.startswith(_HEALTH_PREFIX):
            return continuation(handler_call_details)
        error = self._tokens.refuse(handler_call_details.invocation_metadata)
        if error is None:
            return continuation(handler_call_details)
        # A handler of streams ends the call before its message is read.
        return grpc.stream_stream_rpc_method_handler(partial(self._refuse, error, handler_call_details.method))

    def _refuse(
        self, error: TokenError, path: str, _requests: Iterator[bytes], context: grpc.ServicerContext
    ) -> NoReturn:
        # The caller chose the path, so it goes into the log, shortened, and not into a label.
        self._metrics.requests.labels("any", status_of(error)).inc()
        log(logging.INFO, "refused", reason=str(error), method=path[:100], code=status_of(error), peer=context.peer())
        context.abort_with_status(status_from_error(error))


def server_credentials(config: ServeConfig) -> grpc.ServerCredentials | None:
    """TLS as configured, or None.

    Raises:
        UsageError: A file cannot be read, or --client-ca holds no certificate.
    """
    if config.tls_certificate is None or config.tls_key is None:
        return None
    pair = (_read(config.tls_key, "--tls-key"), _read(config.tls_certificate, "--tls-certificate"))
    authority = _read_authority(config.client_ca) if config.client_ca else None
    return grpc.ssl_server_credentials([pair], authority, require_client_auth=authority is not None)


def read_tokens(path: Path) -> list[bytes]:
    """Accepted bearer tokens, one a line.

    Raises:
        UsageError: The file cannot be read or holds none.
    """
    tokens = [line.strip() for line in _read(path, "--token-file").splitlines() if line.strip()]
    if not tokens:
        raise UsageError(f"--token-file {path} holds no token; expected one a line")
    return tokens


def _read_authority(path: Path) -> bytes:
    data = _read(path, "--client-ca")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_verify_locations(cadata=data.decode("ascii"))
    except (ssl.SSLError, ValueError) as exc:  # ValueError: no ASCII, or empty
        raise UsageError(f"--client-ca {path} cannot be used; expected a PEM file of certificates") from exc
    return data


def _read(path: Path, flag: str) -> bytes:
    try:
        return read_given(path)
    except OSError as exc:
        raise UsageError(f"{flag} {path} cannot be read: {exc.strerror}") from exc
