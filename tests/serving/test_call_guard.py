"""A fault of ours: its caller hears of it, the count has it, and the log says where."""

import logging

import pytest
from curio_serve.api.pose_detector import CallGuard
from curio_serve.errors import InternalError
from curio_serve.telemetry import LOGGER, Metrics
from prometheus_client import CollectorRegistry


class Caller:
    def peer(self) -> str:
        return "ipv4:127.0.0.1:1"


def test_an_unforeseen_fault_is_answered_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    registry = CollectorRegistry()

    def fail() -> str:
        raise ZeroDivisionError("of ours")

    with caplog.at_level(logging.ERROR, LOGGER.name):
        LOGGER.addHandler(caplog.handler)
        try:
            answer = CallGuard(Metrics(registry)).attempt("Detect", "7", Caller(), fail)
        finally:
            LOGGER.removeHandler(caplog.handler)
    assert isinstance(answer, InternalError)
    assert "of ours" not in str(answer), "what went wrong inside is the log's business"
    assert registry.get_sample_value("curio_requests_total", {"method": "Detect", "code": "INTERNAL"}) == 1
    assert any(record.exc_info and record.exc_info[0] is ZeroDivisionError for record in caplog.records)
