"""What the container image holds and weighs, made as its Dockerfile makes it, without a container engine.

    python benchmarks/image.py [--json]

install_mb        of ``deploy/install.sh`` into an empty folder: all the image has over its base
parts_mb          its largest packages
image_mb          with the base image's BASE_MB, which is not measured here (container.py builds it)
starts_read_only  the installed server serves a model from there, and not one file of the folder changes by it
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from load.generator import MODEL, WIDTH, K
from load.network import write_model

BASE_MB = 130  # python:3.12-slim, unpacked, rounded up
_ROOT = Path(__file__).parents[1]
_FORBIDDEN = ("torch", "mitsuba", "drjit", "onnx", "trimesh")


@dataclass(frozen=True)
class Arguments:
    """Measure what the image holds."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""


def main() -> None:
    """Installs, measures, starts, and leaves nothing behind."""
    arguments = tyro.cli(Arguments)
    with tempfile.TemporaryDirectory() as name:
        prefix, models = Path(name) / "curio", Path(name) / "models"
        environment = {**os.environ, "PYTHON": sys.executable}
        subprocess.run([_ROOT / "deploy" / "install.sh", prefix], check=True, stdout=sys.stderr, env=environment)
        (site,) = prefix.glob("lib/python*/site-packages")
        if found := [package for package in _FORBIDDEN if (site / package).exists()]:
            raise SystemExit(f"image: {found} came with the serving install; expected none of {_FORBIDDEN}")
        install_mb = megabytes(prefix)
        largest = sorted(((megabytes(part), part.name) for part in site.iterdir()), reverse=True)[:8]
        write_model(models / MODEL, K, WIDTH)
        figures = {
            "install_mb": install_mb,
            "parts_mb": {part: size for size, part in largest},
            "image_mb": round(install_mb + BASE_MB, 1),
            "starts_read_only": starts_unchanged(prefix, models),
        }
    print(json.dumps(figures) if arguments.json else "\n".join(f"{k:18} {v}" for k, v in figures.items()))


def starts_unchanged(prefix: Path, models: Path) -> bool:
    """Whether the server serves from there, answers its health check, ends well, and writes nothing there."""
    before = stamps(prefix)
    environment = {"PATH": f"{prefix}/bin:/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        [prefix / "bin/curio-serve", models, "--port", "0"], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    port = process.stdout.readline().strip().rpartition(":")[2]
    check = [prefix / "bin/python", _ROOT / "deploy" / "healthcheck.py", port]
    is_healthy = subprocess.run(check, check=False, env=environment).returncode == 0
    process.terminate()
    return process.wait(timeout=60) == 0 and is_healthy and stamps(prefix) == before


def stamps(folder: Path) -> dict[str, int]:
    """When each file and folder was last changed."""
    return {str(path): path.lstat().st_mtime_ns for path in folder.rglob("*")}


def megabytes(path: Path) -> float:
    """Size of a file or of all files below a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return round(sum(file.lstat().st_size for file in files if not file.is_symlink() and file.is_file()) / 1e6, 1)


if __name__ == "__main__":
    main()
