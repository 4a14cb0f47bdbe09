"""Signals: training finishes its step first, everything else stops at once and in one line."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from curio_train.commands.command_line.running import answer
from curio_train.learning.runs.interruption import Interrupted, Interruption, interruptible


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_the_step_at_hand_and_a_second_one_does_not(signum: signal.Signals) -> None:
    with interruptible() as interruption, interruption.deferred():
        signal.raise_signal(signum)
        assert interruption.signum == signum
        with pytest.raises(Interrupted) as caught:
            signal.raise_signal(signum)
    assert caught.value.exit_status == 128 + signum


def test_outside_training_a_signal_stops_at_once_and_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Interrupted), interruptible():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_signal_that_a_library_makes_an_error_of_is_still_a_signal(capsys: pytest.CaptureFixture[str]) -> None:
    def trace(_: Interruption) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except Interrupted as exc:
            raise TypeError("argument 'size' failed to unpack the object") from exc
        return 0

    assert answer(trace) == 128 + signal.SIGTERM
    assert "stopped by SIGTERM" in capsys.readouterr().err


def test_what_is_stopped_before_its_first_step_says_how_to_go_on(tmp_path: Path) -> None:
    few = "{'train': 100, 'validation': 50, 'test': 50}"  # spheres, which are drawn before
    script = f"from curio_train.worlds import image_sets; image_sets.NUM_IMAGES = {few}"
    script += "; from curio_train.commands.train import train; train()"
    command = [sys.executable, "-c", script, "spheres", "--out", "run", "--cache", "cache"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as training:
        deadline = time.monotonic() + 240
        while not (tmp_path / "run" / "config.json").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        training.send_signal(signal.SIGTERM)
        assert training.stderr is not None
        told = training.stderr.read()
    assert training.returncode == 128 + signal.SIGTERM
    assert "stopped by SIGTERM" in told
    assert re.search(r"go on with: curio-train spheres --resume \S*run\n", told)
