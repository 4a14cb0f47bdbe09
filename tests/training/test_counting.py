"""Long work says how far it is."""

import pytest
from curio_train import counting
from curio_train.counting import counted


def test_work_says_how_far_it_is_and_short_work_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(counted("abc", 3, "spelling")) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""
    clock_s = iter([0, 1, 6, 11, 16, 24])  # at the beginning and before each letter
    monkeypatch.setattr(counting.time, "monotonic", lambda: next(clock_s))
    assert "".join(counted("abcde", 5, "spelling")) == "abcde"
    assert capsys.readouterr().err.splitlines() == [
        "spelling: 2 of 5, about 16 s left",
        "spelling: 4 of 5, about 6 s left",
    ]
