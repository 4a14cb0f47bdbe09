"""Clients that are used wrongly: every mistake is an exception of ``curio_serve.errors``, before anything is sent."""

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest
from curio_serve.client import AsyncPoseClient, PoseClient, Tls
from curio_serve.errors import ArgumentError, Unavailable, UsageError

NOWHERE = "127.0.0.1:1"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"address": ""}, "address ''"),
        ({"address": None}, "address None"),
        ({"token": None}, "token None: expected text"),
        ({"max_attempts": "x"}, "max_attempts 'x': expected a number"),
    ],
)
def test_a_client_is_not_made_of_what_is_none(options: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        PoseClient(**{"address": NOWHERE, **options})


def test_deadlines_and_models_are_checked_before_a_call() -> None:
    with pytest.raises(ArgumentError, match="timeout_s None: expected seconds"):
        PoseClient(NOWHERE, timeout_s=None)  # type: ignore[arg-type]
    with PoseClient(NOWHERE) as client:
        with pytest.raises(ArgumentError, match="timeout_s '5': expected seconds"):
            client.list_models(timeout_s="5")  # type: ignore[arg-type]
        for model in (5, b"ape"):
            with pytest.raises(ArgumentError, match="expected a name as text"):
                client.get_model(model)  # type: ignore[arg-type]
        with pytest.raises(ArgumentError, match="expected a name in UTF-8"):
            client.get_model("ape\udc80")
        for view in ((b"", None), (b"", None, [[1, 0], [0]]), (b"", None, "left"), 5):
            with pytest.raises(ArgumentError, match=r"views\[0\]: expected \(image, camera, cam_from_rig"):
                client.detect_views("ape", [view])  # type: ignore[list-item]


def test_tls_takes_pem_files(tmp_path: Path) -> None:
    (tmp_path / "ca.der").write_bytes(bytes(100))
    with pytest.raises(UsageError, match=r"ca\.der: expected a PEM file"):
        PoseClient(NOWHERE, tls=Tls(tmp_path / "ca.der"))


def test_a_closed_client_says_so() -> None:
    with PoseClient(NOWHERE) as client:
        pass
    for call in (client.list_models, lambda: list(client.detect_stream([], timeout_s=1))):
        with pytest.raises(UsageError, match="the client is closed"):
            call()

    async def closed() -> None:
        async with AsyncPoseClient(NOWHERE) as other:
            pass
        await other.list_models()

    with pytest.raises(UsageError, match="the client is closed"):
        asyncio.run(closed())


def test_a_client_that_is_closed_between_two_attempts_says_so() -> None:
    client = PoseClient(NOWHERE, max_attempts=1000)
    closing = threading.Timer(0.3, client.close)
    closing.start()
    with pytest.raises((UsageError, Unavailable), match=r"closed|CANCELLED"):
        client.list_models(timeout_s=30)
    closing.join()
