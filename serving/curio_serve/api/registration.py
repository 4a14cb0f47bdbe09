"""Puts services on a gRPC server so that a message nobody can read is answered like any other bad request.

Left to itself, grpcio answers such a message but never lets go of its call: after as many of them as a connection may
have streams, that connection is dead, and a server with any of them waits out its whole grace time at the end. Here the
bytes come to the handler's thread unread, and are parsed there.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial, update_wrapper
from typing import Any

import grpc
from google.protobuf.descriptor import MethodDescriptor, ServiceDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from curio_serve.api.messages import status_from_error, unreadable

Behavior = Callable[..., Any]


def register(server: grpc.Server, service: ServiceDescriptor, servicer: object) -> None:
    """Answer a service's calls (one message or streams both ways) with the servicer's methods of the same names.

    Args:
        server: Not started yet.
        service: Its description.
        servicer: Has a method for each of the service's.
    """
    handlers = {
        f"/{service.full_name}/{method.name}": _handler(method, getattr(servicer, method.name))
        for method in service.methods
    }
    server.add_generic_rpc_handlers((_Handlers(handlers),))


class _Handlers(grpc.GenericRpcHandler):
    def __init__(self, handlers: Mapping[str, grpc.RpcMethodHandler]) -> None:
        self._handlers = handlers

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        return self._handlers.get(handler_call_details.method)


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
        context.abort_with_status(status_from_error(unreadable(kind, len(data))))
        raise
