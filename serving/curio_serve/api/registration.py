"""Registers services on a gRPC server, which then answers an unreadable message like any other bad request.

grpcio itself answers such a message but never releases its call: after as many of them as a connection may have
streams, that connection is dead, and the server waits out its whole grace time at the end. So the bytes are parsed
here, on the handler's thread.

Every method is registered as one that takes a stream of messages, which is the same on the wire. So a method may refuse
a call before its message is read.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial, update_wrapper
from typing import Any, TypeVar

import grpc
from google.protobuf.descriptor import MethodDescriptor, ServiceDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from curio_serve.api.status import status_from_error
from curio_serve.errors import ArgumentError, CallCancelled, CurioError

Behavior = Callable[..., Any]
Request = TypeVar("Request", bound=Message)


def register(server: grpc.Server, service: ServiceDescriptor, servicer: object, unread: Collection[str] = ()) -> None:
    """Answer a service's calls (one message or streams both ways) with the servicer's methods of the same names.

    A method may raise CurioError; its call ends with the status that stands for the error.

    Args:
        server: Not started yet.
        service: Its description.
        servicer: Has a method for each of the service's.
        unread: Methods with one message that get an iterator over it instead, for :func:`only_message`.
    """
    handlers = {
        f"/{service.full_name}/{method.name}": _handler(
            method, getattr(servicer, method.name), method.client_streaming or method.name in unread
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
    raise ArgumentError("the call ended before its message had come; expected one message")


class _Handlers(grpc.GenericRpcHandler):
    def __init__(self, handlers: Mapping[str, grpc.RpcMethodHandler]) -> None:
        self._handlers = handlers

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        return self._handlers.get(handler_call_details.method)


def _handler(method: MethodDescriptor, behavior: Behavior, takes_iterator: bool) -> grpc.RpcMethodHandler:
    answer = _answer_stream if method.client_streaming else _answer
    take = iter if takes_iterator else only_message
    wrapped: Behavior = partial(answer, behavior, partial(_messages, GetMessageClass(method.input_type)), take)
    # grpcio reads from the behaviour's attributes on which threads it is to run.
    update_wrapper(wrapped, behavior)
    serializer = GetMessageClass(method.output_type).SerializeToString
    if method.server_streaming:
        return grpc.stream_stream_rpc_method_handler(wrapped, response_serializer=serializer)
    return grpc.stream_unary_rpc_method_handler(wrapped, response_serializer=serializer)


def _answer(
    behavior: Behavior, parse: Behavior, take: Behavior, data: Iterator[bytes], context: Any, *more: Any
) -> Any:
    try:
        return behavior(take(parse(data)), context, *more)
    except CurioError as exc:
        context.abort_with_status(status_from_error(exc))


def _answer_stream(
    behavior: Behavior, parse: Behavior, take: Behavior, data: Iterator[bytes], context: Any
) -> Iterator[Any]:
    try:
        yield from behavior(take(parse(data)), context)
    except CurioError as exc:
        context.abort_with_status(status_from_error(exc))


def _messages(kind: type[Message], messages: Iterator[bytes]) -> Iterator[Message]:
    try:
        for data in messages:
            yield _parse(kind, data)
    except grpc.RpcError as exc:
        raise CallCancelled("the client hung up before its message had come") from exc


def _parse(kind: type[Message], data: bytes) -> Message:
    try:
        return kind.FromString(data)
    except DecodeError as exc:
        name = kind.DESCRIPTOR.full_name
        raise ArgumentError(
            f"the message of {len(data)} bytes cannot be read as {name}; was the client made for this API?"
        ) from exc
