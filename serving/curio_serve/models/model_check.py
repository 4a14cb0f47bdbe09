"""Loads one model version under limits and says whether it can serve.

    python -m curio_serve.models.model_check FOLDER VERSION

The server runs this before it opens a candidate itself, so a file that crashes or exhausts the runtime takes this
process and not the server. Exit status 0: fit; 1: refused, the last line on stderr says why.
"""

import resource
import subprocess
import sys
from pathlib import Path

from curio_serve.errors import ModelError

MAX_MEMORY_BYTES = 4 << 30
MAX_CPU_S = 30
TIMEOUT_S = 60


class ChildCheck:
    """Checks candidates, one at a time, each in a process of its own."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None

    def __call__(self, folder: Path, version: int) -> None:
        """Check a version.

        Raises:
            ModelError: What the child said, or how it died.
        """
        command = [sys.executable, "-m", "curio_serve.models.model_check", str(folder), str(version)]
        try:
            child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        except OSError as exc:  # no memory, no process, no file left for it
            raise ModelError(f"{folder / str(version)}: its check could not be started: {exc.strerror}") from exc
        with child:
            self._child = child
            try:
                _, said = child.communicate(timeout=TIMEOUT_S)
            except subprocess.TimeoutExpired as exc:
                child.kill()
                raise ModelError(f"{folder / str(version)}: its check took longer than {TIMEOUT_S} s") from exc
        last = (said.strip().splitlines() or ["without a word"])[-1]
        if child.returncode == 1:
            raise ModelError(last)
        if child.returncode:
            raise ModelError(f"{folder / str(version)}: its check ended with status {child.returncode}: {last}")

    def stop(self) -> None:
        """End a check that is going on; it counts as failed."""
        if self._child is not None:
            self._child.kill()


def main() -> int:
    """Check the model version that the arguments name."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # After the limits, so that they hold for the libraries too.
    from curio_serve.models.model_folder import load_version

    try:
        load_version(Path(sys.argv[1]), int(sys.argv[2]))
    except ModelError as exc:
        print(" ".join(str(exc).split()), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
