"""Every exception of serving has a gRPC status, and finds its way back."""

import grpc
import pytest
from curio_serve import errors


def _all_errors() -> list[type[errors.CurioError]]:
    found, waiting = [], [errors.CurioError]
    while waiting:
        kind = waiting.pop()
        found.append(kind)
        waiting += kind.__subclasses__()
    return found


@pytest.mark.parametrize("kind", _all_errors(), ids=lambda kind: kind.__name__)
def test_there_and_back(kind: type[errors.CurioError]) -> None:
    status = errors.status_of(kind("why"))
    assert status in grpc.StatusCode.__members__
    back = errors.error_from_status(status, kind.__name__, "why")
    assert type(back) is kind
    assert str(back) == "why"


def test_the_tree_is_drawn_completely() -> None:
    drawing = errors.__doc__ or ""
    assert [kind.__name__ for kind in _all_errors() if kind.__name__ not in drawing] == []


@pytest.mark.parametrize("status", [code.name for code in grpc.StatusCode if code is not grpc.StatusCode.OK])
def test_other_servers_statuses_become_errors(status: str) -> None:
    error = errors.error_from_status(status, "", "text of another server")
    assert "text of another server" in str(error)
    if status in errors.STATUS_OF.values():
        assert errors.status_of(error) == status
    else:
        assert isinstance(error, errors.InternalError)


def test_exit_statuses() -> None:
    wrong_calls = {kind for kind in _all_errors() if kind.exit_status == 2}
    assert wrong_calls == {errors.UsageError}
