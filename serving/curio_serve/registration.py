"""Puts services on a gRPC server so that a message nobody can read is answered like any other bad request.

Left to itself, grpcio answers such a message but never lets go of its call: after as many of them as a connection may
have streams, that connection is dead, and a server with any of them waits out its whole grace time at the end. Here the
bytes come to the handler's thread unread, and are parsed there.

And a call whose work would find no place in the queue is refused before its message is read, which is most of what such
a call costs: under a flood the time goes to calls that are answered.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial, update_wrapper
from typing import Any, Protocol

import grpc
from google.protobuf.descriptor import MethodDescriptor, ServiceDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from curio_serve.admission import WorkQueue
from curio_serve.errors import ArgumentError
from curio_serve.wire import status_from_error

Behavior = Callable[..., Any]


class Refusing(Protocol):
    """A servicer whose work goes through the queue."""

    def refuse(self, method: str, context: Any) -> None:
        """Abort a call of that method because the queue is full."""


def register(server: grpc.Server, service: ServiceDescriptor, servicer: object) -> None:
    """Answer a service's calls (one message or streams both ways) with the servicer's methods of the same names."""
    server.add_generic_rpc_handlers((_Handlers(_handlers(service, servicer)),))


def register_behind(
    work: WorkQueue, server: grpc.Server, service: ServiceDescriptor, servicer: Refusing, methods: Collection[str]
) -> None:
    """The same; calls of these methods are refused by the servicer while the queue is full."""
    refusals = {f"/{service.full_name}/{name}": _refusal(servicer, name) for name in methods}
    server.add_generic_rpc_handlers((_Handlers(_handlers(service, servicer), work, refusals),))


class _Handlers(grpc.GenericRpcHandler):
    """Chooses how a call is answered when it comes, before its message."""

    def __init__(
        self,
        handlers: Mapping[str, grpc.RpcMethodHandler],
        work: WorkQueue | None = None,
        refusals: Mapping[str, grpc.RpcMethodHandler] | None = None,
    ) -> None:
        self._handlers, self._work, self._refusals = handlers, work, refusals or {}

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        method = handler_call_details.method
        if self._work is not None and self._work.is_full and method in self._refusals:
            return self._refusals[method]
        return self._handlers.get(method)


def _handlers(service: ServiceDescriptor, servicer: object) -> dict[str, grpc.RpcMethodHandler]:
    return {f"/{service.full_name}/{m.name}": _handler(m, getattr(servicer, m.name)) for m in service.methods}


def _refusal(servicer: Refusing, method: str) -> grpc.RpcMethodHandler:
    """A stream's handler, whatever the method: it need not take the message."""
    return grpc.stream_stream_rpc_method_handler(lambda _requests, context: servicer.refuse(method, context))


def _handler(method: MethodDescriptor, behavior: Behavior) -> grpc.RpcMethodHandler:
    wrap = _with_messages if method.client_streaming else _with_message
    wrapped: Behavior = partial(wrap, behavior, GetMessageClass(method.input_type))
    # grpcio reads from the behaviour's attributes on which threads it wants to run.
    update_wrapper(wrapped, behavior)
    serializer = GetMessageClass(method.output_type).SerializeToString
    if method.client_streaming:
        return grpc.stream_stream_rpc_method_handler(wrapped, response_serializer=serializer)
    if method.server_streaming:
        return grpc.unary_stream_rpc_method_handler(wrapped, response_serializer=serializer)
    return grpc.unary_unary_rpc_method_handler(wrapped, response_serializer=serializer)


def _with_message(behavior: Behavior, kind: type[Message], data: bytes, context: Any, *more: Any) -> Any:
    return behavior(_parse(kind, data, context), context, *more)


def _with_messages(behavior: Behavior, kind: type[Message], data: Iterator[bytes], context: Any) -> Any:
    return behavior((_parse(kind, one, context) for one in data), context)


def _parse(kind: type[Message], data: bytes, context: grpc.ServicerContext) -> Message:
    try:
        return kind.FromString(data)
    except DecodeError:
        name = kind.DESCRIPTOR.full_name
        error = ArgumentError(
            f"the message of {len(data)} bytes cannot be read as {name}; was the client made for this API?"
        )
        context.abort_with_status(status_from_error(error))
        raise
