"""A fault of ours ends the call that it came up in, and nothing else: no slot is lost, no thread, no other call."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_serve.errors import CurioError
from curio_serve.server.admission import WorkQueue
from curio_serve.server.direct_calls import Caller, DirectCalls, Metadata, Method
from curio_serve.server.events import share_events
from curio_serve.telemetry import LOGGER, Metrics
from prometheus_client import CollectorRegistry

BAD, GOOD = pb.DetectRequest(request_id="bad"), pb.DetectRequest(request_id="good")
MAX_WAITING = 2


class Work:
    """Answers a call when it may, unless that is bad."""

    def __init__(self) -> None:
        self.has_begun, self.may_end = threading.Semaphore(0), threading.Event()
        self.may_end.set()

    def answer(self, request: pb.DetectRequest, _caller: Caller, _waited_s: float) -> pb.DetectResponse:
        self.has_begun.release()
        assert self.may_end.wait(30)
        if request.request_id == "bad":
            raise ZeroDivisionError("of ours")
        return pb.DetectResponse(request_id=request.request_id)


def refuse(metadata: Metadata) -> CurioError | None:
    """Fails for callers who say so."""
    if any(key == "fault" for key, _ in metadata):
        raise ZeroDivisionError("of ours")
    return None


@contextmanager
def _served(work: Work) -> Iterator[PoseDetectorStub]:
    """A client of a server with one slot."""
    options = [("grpc.so_reuseport", 0)]
    server = grpc.server(ThreadPoolExecutor(1), options=options)
    events = share_events(server, options)
    waiting = WorkQueue(1, MAX_WAITING, Metrics(CollectorRegistry()))
    method = Method("/curio.v1.PoseDetector/Detect", pb.DetectRequest, work.answer, lambda *_: None)
    direct = DirectCalls(server, events, waiting, [method], 8, refuse)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    direct.start()
    try:
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            yield PoseDetectorStub(channel)
    finally:
        server.stop(None).wait()
        direct.stop()


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    """What the server logs."""
    LOGGER.addHandler(caplog.handler)
    yield caplog
    LOGGER.removeHandler(caplog.handler)


def _num_logged(log: pytest.LogCaptureFixture) -> int:
    # A set, because a record may come by two ways.
    return len({record for record in log.records if record.exc_info and record.exc_info[0] is ZeroDivisionError})


@pytest.mark.parametrize(("request_", "metadata"), [(BAD, ()), (GOOD, (("fault", "1"),))], ids=["answer", "event"])
def test_calls_go_on_after_faults(
    request_: pb.DetectRequest, metadata: Metadata, log: pytest.LogCaptureFixture
) -> None:
    with _served(Work()) as stub:
        # More than there are threads, slots and places in the queue.
        for _ in range(8):
            with pytest.raises(grpc.RpcError) as caught:
                stub.Detect(request_, timeout=30, metadata=metadata)
            assert caught.value.code() is grpc.StatusCode.CANCELLED
        assert [stub.Detect(GOOD, timeout=30).request_id for _ in range(8)] == ["good"] * 8
    assert _num_logged(log) == 8


def test_who_waits_behind_a_fault_is_answered(log: pytest.LogCaptureFixture) -> None:
    work = Work()
    work.may_end.clear()
    with _served(work) as stub:
        bad = stub.Detect.future(BAD, timeout=30)
        assert work.has_begun.acquire(timeout=30)
        waiting = [stub.Detect.future(GOOD, timeout=30) for _ in range(MAX_WAITING)]
        # While the only slot is taken, a call that fails on its way in.
        faulty = stub.Detect.future(GOOD, timeout=30, metadata=(("fault", "1"),))
        assert faulty.exception(timeout=30).code() is grpc.StatusCode.CANCELLED
        work.may_end.set()
        assert bad.exception(timeout=30).code() is grpc.StatusCode.CANCELLED
        assert [call.result(timeout=30).request_id for call in waiting] == ["good"] * MAX_WAITING
    assert _num_logged(log) == 2


class ShortWork(Work):
    """Takes so long that calls come faster, and so short that no further thread listens meanwhile."""

    def answer(self, request: pb.DetectRequest, caller: Caller, waited_s: float) -> pb.DetectResponse:
        time.sleep(0.01)
        return super().answer(request, caller, waited_s)


def test_a_flood_is_refused_while_all_work() -> None:
    """What is not heard would wait inside gRPC for as long as it likes."""
    with _served(ShortWork()) as stub:
        calls = [stub.Detect.future(GOOD, timeout=30) for _ in range(100)]
        ends = Counter(error.code() if (error := call.exception()) else grpc.StatusCode.OK for call in calls)
    assert ends.keys() == {grpc.StatusCode.OK, grpc.StatusCode.RESOURCE_EXHAUSTED}
    assert MAX_WAITING < ends[grpc.StatusCode.OK] < 50
