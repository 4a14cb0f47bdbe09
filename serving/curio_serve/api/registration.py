"""Registers services on a gRPC server, which then answers an unreadable message like any other bad request.

grpcio itself answers such a message but never releases its call: after as many of them as a connection may have
streams, that connection is dead, and the server waits out its whole grace time at the end. So the bytes are parsed
here, on the handler's thread.

Every method is registered as one that takes a stream of messages, which is the same on the wire. So a method may refuse
a call before its message is read.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from functools import partial, update_wrapper
from typing import Any, TypeVar, cast

import grpc
from google.protobuf.descriptor import Descriptor, MethodDescriptor, ServiceDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from curio_serve.api.status import status_from_error
from curio_serve.api.wire_limits import check_counts
from curio_serve.errors import ArgumentError, CurioError

Behavior = Callable[..., Any]
Receive = Callable[[Iterator[bytes], grpc.ServicerContext, bool], Iterator[bytes]]
Request = TypeVar("Request", bound=Message)


def register(
    server: grpc.Server, service: ServiceDescriptor, servicer: object, receive: Receive, unread: Collection[str] = ()
) -> None:
    """Answer a service's calls (one message or streams both ways) with the servicer's methods of the same names.

    A method may raise CurioError; its call ends with the status that stands for the error.

    Args:
        server: Not started yet.
        service: Its description.
        servicer: Has a method for each of the service's.
        receive: Bounds how a call's messages arrive: given their iterator, gRPC's context and whether there may be
            several, gives an iterator.
        unread: Methods with one message that get an iterator over it instead, for :func:`only_message`.
    """
    handlers = {
        f"/{service.full_name}/{method.name}": _handler(
            method, getattr(servicer, method.name), receive, method.client_streaming or method.name in unread
        )
        for method in service.methods
    }
    server.add_generic_rpc_handlers((_Handlers(handlers),))


def only_message(messages: Iterator[Request]) -> Request:
    """Wait for the message of a call that has one.

    Raises:
        ArgumentError: The call has none, or its message cannot be read.
        CallCancelled: The client hung up first.
    """
    for message in messages:
        return message
    raise ArgumentError("the call ended without a message; expected one message")


class _Handlers(grpc.GenericRpcHandler):
    def __init__(self, handlers: Mapping[str, grpc.RpcMethodHandler]) -> None:
        self._handlers = handlers

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        return self._handlers.get(handler_call_details.method)


def _handler(
    method: MethodDescriptor, behavior: Behavior, receive: Receive, takes_iterator: bool
) -> grpc.RpcMethodHandler:
    answer = _answer_stream if method.client_streaming else _answer
    take = iter if takes_iterator else only_message
    read = partial(_messages, GetMessageClass(method.input_type), receive, method.client_streaming)
    wrapped: Behavior = partial(answer, behavior, read, take)
    # grpcio reads from the behaviour's attributes on which threads it is to run.
    update_wrapper(wrapped, behavior)
    serializer = GetMessageClass(method.output_type).SerializeToString
    if method.server_streaming:
        return grpc.stream_stream_rpc_method_handler(wrapped, response_serializer=serializer)
    return grpc.stream_unary_rpc_method_handler(wrapped, response_serializer=serializer)


def _answer(behavior: Behavior, read: Behavior, take: Behavior, data: Iterator[bytes], context: Any, *more: Any) -> Any:
    try:
        with closing(read(data, context)) as messages:
            return behavior(take(messages), context, *more)
    except CurioError as exc:
        context.abort_with_status(status_from_error(exc))


def _answer_stream(
    behavior: Behavior, read: Behavior, take: Behavior, data: Iterator[bytes], context: Any
) -> Iterator[Any]:
    try:
        with closing(read(data, context)) as messages:
            yield from behavior(take(messages), context)
    except CurioError as exc:
        context.abort_with_status(status_from_error(exc))


def _messages(
    kind: type[Message], receive: Receive, is_stream: bool, data: Iterator[bytes], context: grpc.ServicerContext
) -> Iterator[Message]:
    # A map, because it holds no raw bytes while a message is worked on.
    yield from map(partial(_parse, kind), receive(data, context, is_stream))


def _parse(kind: type[Message], data: bytes) -> Message:
    check_counts(cast(Descriptor, kind.DESCRIPTOR), data)
    try:
        return kind.FromString(data)
    except DecodeError as exc:
        name = kind.DESCRIPTOR.full_name
        raise ArgumentError(
            f"the message of {len(data)} bytes cannot be read as {name}; was the client made for this API?"
        ) from exc
