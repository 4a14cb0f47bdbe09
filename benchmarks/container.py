"""The image itself: built and run by a container engine, held to what its Dockerfile and compose file promise.

    python benchmarks/container.py [--engine podman] [--base python:3.12-slim] [--json]

base_mb, image_mb   sizes as the engine counts them
ready_s             from starting the container to its first answer
user                whose id its processes have
is_read_only        whether its root file system is mounted so
is_healthy          what the image's health check says
same_answers        whether curio-detect's lines through it are those of the model outside, times apart
exit_status         after SIGTERM

The container has no capabilities, and its port is published on the loopback alone. How many megabytes of the image
are ours without an engine at hand: image.py.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from curio_serve.client import PoseClient
from curio_serve.errors import CurioError

_ROOT = Path(__file__).parents[1]
_MODEL = "ape"
_RUN = ("--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--memory", "1g")
_READY_WITHIN_S = 60.0


@dataclass(frozen=True)
class Arguments:
    """Build the server's image, run it, and see what it promises."""

    engine: str = "docker"
    """docker or podman."""
    base: str = "python:3.12-slim"
    """Image to build on: any with Python 3.11 or newer."""
    json: bool = False
    """Print one JSON object on the last line instead of a table."""


@dataclass(frozen=True)
class Engine:
    """A container engine's command line."""

    command: str

    def __call__(self, *arguments: str) -> str:
        """What it prints; the benchmark ends where it fails."""
        done = subprocess.run([self.command, *arguments], stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise SystemExit(
                f"container: {self.command} {arguments[0]} ended with {done.returncode}; its words are above"
            )
        return done.stdout.strip()

    def succeeds(self, *arguments: str) -> bool:
        """Whether it ends with 0."""
        return subprocess.run([self.command, *arguments], capture_output=True, check=False).returncode == 0

    def megabytes(self, image: str) -> float:
        """Size of an image."""
        return round(int(self("image", "inspect", "--format", "{{.Size}}", image)) / 1e6, 1)


@dataclass(frozen=True)
class Seen:
    """What was seen of a running container."""

    ready_s: float
    user: int
    is_read_only: bool
    is_healthy: bool
    same_answers: bool
    exit_status: int


def main() -> None:
    """Builds, runs, and removes the container; the image stays."""
    arguments = tyro.cli(Arguments)
    engine = Engine(arguments.engine)
    image = "curio-serve:benchmark"
    built = ("--file", str(_ROOT / "deploy" / "Dockerfile"), "--tag", image)
    if not engine.succeeds("image", "inspect", arguments.base):
        engine("pull", arguments.base)
    print(engine("build", "--build-arg", f"BASE={arguments.base}", *built, str(_ROOT)), file=sys.stderr)
    figures = {"engine": engine("--version"), "base": arguments.base, "base_mb": engine.megabytes(arguments.base)}
    figures |= {"image_mb": engine.megabytes(image), **asdict(seen(engine, image))}
    print(json.dumps(figures) if arguments.json else "\n".join(f"{k:18} {v}" for k, v in figures.items()))


def seen(engine: Engine, image: str) -> Seen:
    """Run the image on the repository's models, once."""
    begun = time.monotonic()
    mount = f"{_ROOT / 'models'}:/models:ro"
    name = engine("run", "--detach", *_RUN, "--publish", "127.0.0.1::8500", "--volume", mount, image)
    try:
        address = engine("port", name, "8500").splitlines()[0]
        ready_s = wait_for(address, begun)
        inside = ("exec", name, "python")
        found = {
            "ready_s": round(ready_s, 2),
            "user": int(engine(*inside, "-c", "import os; print(os.getuid())")),
            "is_read_only": engine(*inside, "-c", "import os; print(os.statvfs('/').f_flag & os.ST_RDONLY)") == "1",
            "is_healthy": engine.succeeds(*inside, "/opt/curio/healthcheck.py"),
            "same_answers": lines(f"{address}/{_MODEL}") == lines(str(_ROOT / "models" / _MODEL)),
        }
        engine("stop", "-t", "40", name)
        return Seen(exit_status=int(engine("inspect", "--format", "{{.State.ExitCode}}", name)), **found)
    finally:
        engine.succeeds("rm", "--force", name)


def wait_for(address: str, begun: float) -> float:
    """Seconds from ``begun`` until the server lists its models."""
    while time.monotonic() < begun + _READY_WITHIN_S:
        try:
            with PoseClient(address) as client:
                if client.list_models(timeout_s=1):
                    return time.monotonic() - begun
        except CurioError:
            time.sleep(0.05)
    raise SystemExit(f"container: no answer on {address} within {_READY_WITHIN_S:.0f} s")


def lines(model: str) -> list[dict[str, object]]:
    """curio-detect's results on the sample frames, without how long each took."""
    samples = _ROOT / "samples"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "poses.jsonl"
        command = [Path(sys.executable).with_name("curio-detect"), model, samples]
        subprocess.run([*command, "--camera", samples / "camera.json", "--out", out], check=True)
        results = [json.loads(line) for line in out.read_text().splitlines()]
    return [{key: value for key, value in result.items() if key != "milliseconds"} for result in results]


if __name__ == "__main__":
    main()
