"""Refuses calls before their messages are read: without a known token, or while the queue is full."""

import logging
from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Any, NoReturn

import grpc
from grpc_health.v1 import health

from curio_serve.api.admission import WorkQueue
from curio_serve.api.messages import status_from_error
from curio_serve.errors import CurioError, status_of
from curio_serve.server.security import Tokens
from curio_serve.telemetry import Metrics, log

_HEALTH_PREFIX = f"/{health.SERVICE_NAME}/"
Handler = grpc.RpcMethodHandler
Continuation = Callable[[grpc.HandlerCallDetails], "Handler[Any, Any] | None"]


class TokenInterceptor(grpc.ServerInterceptor):
    """Lets calls pass that show a known bearer token, and health checks."""

    def __init__(self, tokens: Tokens, metrics: Metrics) -> None:
        """Count refused calls in ``metrics``."""
        self._tokens, self._metrics = tokens, metrics

    def intercept_service(
        self, continuation: Continuation, handler_call_details: grpc.HandlerCallDetails
    ) -> "Handler[Any, Any] | None":
        path = handler_call_details.method
        if path.startswith(_HEALTH_PREFIX):
            return continuation(handler_call_details)
        error = self._tokens.refuse(handler_call_details.invocation_metadata)
        if error is None:
            return continuation(handler_call_details)
        # The caller chose the path, so it goes into the log, shortened, and not into a label.
        self._metrics.requests.labels("any", status_of(error)).inc()
        log(logging.INFO, "refused", method=path[:100], code=status_of(error))
        return _refusing(error)


class AdmissionInterceptor(grpc.ServerInterceptor):
    """Refuses calls while the queue is full: to read a message and refuse it then costs a third of an answer."""

    def __init__(self, work: WorkQueue, paths: Collection[str], metrics: Metrics) -> None:
        """Watch the queue.

        Args:
            work: The queue.
            paths: Of the methods that wait in it, ``/package.Service/Method``.
            metrics: Counts the refused calls.
        """
        self._work, self._metrics = work, metrics
        self._methods = {path: path.rpartition("/")[2] for path in paths}

    def intercept_service(
        self, continuation: Continuation, handler_call_details: grpc.HandlerCallDetails
    ) -> "Handler[Any, Any] | None":
        method = self._methods.get(handler_call_details.method)
        error = None if method is None else self._work.refusal()
        if error is None:
            return continuation(handler_call_details)
        self._metrics.requests.labels(method, status_of(error)).inc()
        return _refusing(error)


def _refusing(error: CurioError) -> "Handler[Any, Any]":
    """Ends a call with an error; gRPC reads the messages of a stream only when they are asked for."""
    return grpc.stream_stream_rpc_method_handler(partial(_abort, status_from_error(error)))


def _abort(status: grpc.Status, _requests: Iterator[bytes], context: grpc.ServicerContext) -> NoReturn:
    context.abort_with_status(status)
