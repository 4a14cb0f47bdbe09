"""Loads a model in a process of its own, under limits of memory and time, and reports whether it can serve.

    python -m curio_serve.models.model_check MODEL_FOLDER VERSION
    python -m curio_serve.models.model_check MODEL

``curio-serve`` and ``curio-detect`` run this before they open a model themselves, so that a file that crashes or
exhausts the runtime ends this process and not theirs. Exit status 0: fit; 1: refused, the last line on stderr says why.
"""

import subprocess
import sys
from pathlib import Path

from curio_serve.errors import CheckNotDone, ModelError
from curio_serve.systems import limit_this_process

MAX_MEMORY_BYTES = 4 << 30
MAX_CPU_S = 30
TIMEOUT_S = 60
_KILLED = -9  # by SIGKILL: from outside, as its own limits send another signal


class ChildCheck:
    """Checks models one at a time, each in a process of its own."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None

    def __call__(self, path: Path, version: int | None = None) -> None:
        """Check a model.

        Args:
            path: A model's folder; without a version anything that :func:`~curio_serve.models.model_folder.open_model`
                takes.
            version: Of the folder.

        Raises:
            ModelError: The last line that the child wrote.
            CheckNotDone: It could not be started, was killed from outside, or took too long.
        """
        arguments = [str(path)] if version is None else [str(path), str(version)]
        label = Path(*arguments)
        # -P: what lies in the working folder is no module of ours.
        command = [sys.executable, "-P", "-m", "curio_serve.models.model_check", *arguments]
        try:
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        except OSError as exc:  # no memory, no process, no file left for it
            raise CheckNotDone(f"{label}: its check could not be started: {exc.strerror}") from exc
        with child:
            self._child = child
            try:
                _, output = child.communicate(timeout=TIMEOUT_S)
            except subprocess.TimeoutExpired as exc:
                raise CheckNotDone(f"{label}: its check took longer than {TIMEOUT_S} s") from exc
            finally:
                child.kill()  # also after Ctrl-C
        last = (output.strip().splitlines() or ["without a word"])[-1]
        if child.returncode == 1:
            raise ModelError(last if str(path) in last else f"{label}: {last}")
        if child.returncode == _KILLED:
            raise CheckNotDone(f"{label}: its check was killed from outside, perhaps for want of memory: {last}")
        if child.returncode:
            raise ModelError(f"{label}: its check ended with status {child.returncode}: {last}")

    def stop(self) -> None:
        """End a check that is running; it counts as failed."""
        if self._child is not None:
            self._child.kill()


def main() -> int:
    """Check the model that the arguments name."""
    limit_this_process(MAX_MEMORY_BYTES, MAX_CPU_S)
    # After the limits, so that they hold for the libraries too.
    from curio_serve.models.model_folder import load_version, open_model

    path, *version = sys.argv[1:]
    try:
        if version:
            load_version(Path(path), int(version[0]))
        else:
            open_model(path)
    except ModelError as exc:
        print(" ".join(str(exc).split()), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
