"""Reads what decides who may call: TLS files, client certificates, bearer tokens."""

import hmac
from collections.abc import Iterable, Sequence
from pathlib import Path

import grpc

from curio_serve.errors import TokenError, UsageError
from curio_serve.server.config import ServeConfig


class Tokens:
    """The bearer tokens that callers may show; none: everybody may call."""

    def __init__(self, known: Sequence[bytes] = ()) -> None:
        self._known = known

    def refuse(self, metadata: Iterable[tuple[str, str | bytes]]) -> TokenError | None:
        """Why a call with this metadata may not be made, if so."""
        if not self._known:
            return None
        shown = dict(metadata).get("authorization", "")
        text = shown.encode() if isinstance(shown, str) else shown
        token = text.removeprefix(b"Bearer ")
        # Every token is compared, in constant time, so that timing tells nothing.
        matches = [hmac.compare_digest(token, known) for known in self._known]
        if token != text and any(matches):
            return None
        return TokenError("bearer token missing or unknown; send the metadata `authorization: Bearer <token>`")


def server_credentials(config: ServeConfig) -> grpc.ServerCredentials | None:
    """TLS as configured, or None.

    Raises:
        UsageError: A file cannot be read.
    """
    if config.tls_certificate is None or config.tls_key is None:
        return None
    pair = (_read(config.tls_key, "--tls-key"), _read(config.tls_certificate, "--tls-certificate"))
    authority = _read(config.client_ca, "--client-ca") if config.client_ca else None
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


def _read(path: Path, flag: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as exc:
        raise UsageError(f"{flag} {path} cannot be read: {exc.strerror}") from exc
