"""Serving and detection work where what only POSIX or Linux has is missing, as it is on Windows and macOS.

A stand-in for those systems: the same interpreter with their names taken away. What behaves otherwise there under the
same name, such as a path with a drive, is not tried by it; ``make check`` has mypy look for names as well.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FRAMES, CAMERA = sorted((ROOT / "samples").glob("*.jpg"))[:2], ROOT / "samples" / "camera.json"
MODULES = ("fcntl", "resource", "pwd", "grp", "termios")
NAMES = {
    "os": ("sched_getaffinity", "O_NONBLOCK", "O_CLOEXEC", "O_NOFOLLOW", "O_DIRECTORY", "getuid", "geteuid", "fork"),
    "signal": ("SIGHUP", "SIGUSR1", "pthread_sigmask", "setitimer"),
    "socket": ("AF_UNIX", "SO_REUSEPORT"),
}
WITHOUT = f"""
import builtins, ctypes, importlib, io, os, pathlib, subprocess, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {MODULES}:
            raise ImportError(name + " is on no such system")

for module, names in {NAMES}.items():
    module = importlib.import_module(module)
    for name in names:
        delattr(module, name)
for name in {MODULES}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())

opening = io.open
def without_proc(file, *args, **kwargs):
    if str(file).startswith(("/proc", "/sys")):
        raise FileNotFoundError(2, "there is no such folder", file)
    return opening(file, *args, **kwargs)
io.open = builtins.open = without_proc

library = ctypes.CDLL.__init__
def no_own_library(self, name, *args, **kwargs):
    if name is None:
        raise TypeError("this process has no C library of its own")
    library(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = no_own_library
"""


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Environment variables under which every Python process lacks them."""
    folder = tmp_path_factory.mktemp("hook")
    (folder / "sitecustomize.py").write_text(WITHOUT)
    return {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}


def python(code: str, environment: Mapping[str, str]) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "code",
    [
        *(f"import {name}" for name in MODULES),
        *(f"import {module}; {module}.{name}" for module, names in NAMES.items() for name in names),
        "open('/proc/self/statm')",
        "import pathlib; pathlib.Path('/proc/self/statm').read_text()",
        "import ctypes; ctypes.CDLL(None)",
    ],
)
def test_what_is_taken_away_is_missing(elsewhere: Mapping[str, str], code: str) -> None:
    assert python(code, {}).returncode == 0, "not even here"
    assert python(code, elsewhere).returncode == 1


def test_every_module_can_be_imported(elsewhere: Mapping[str, str]) -> None:
    base = ROOT / "serving"
    files = (path for path in (base / "curio_serve").rglob("*.py") if path.name != "__init__.py")
    names = [".".join(path.relative_to(base).with_suffix("").parts) for path in files]
    assert len(names) > 30
    done = python(f"import importlib\nfor name in {names}: importlib.import_module(name)", elsewhere)
    assert done.returncode == 0, done.stderr


def detect(out: Path, environment: Mapping[str, str], *flags: str | Path) -> list[dict[str, Any]]:
    """Run ``curio-detect`` on the sample frames; its rows without their times."""
    code = "from curio_serve.batch.detect_cli import main; main()"
    arguments = [ROOT / "models" / "ape", *FRAMES, "--camera", CAMERA, "--out", out, *flags]
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "milliseconds"} for row in rows]


def test_detection_works_and_goes_on(tmp_path: Path, elsewhere: Mapping[str, str]) -> None:
    out = tmp_path / "poses.jsonl"
    here = detect(tmp_path / "here.jsonl", {})
    assert detect(out, elsewhere, "--overlays", tmp_path / "drawn") == here
    assert len(here) == len(FRAMES) == len(list((tmp_path / "drawn").iterdir()))
    out.write_bytes(out.read_bytes().splitlines(keepends=True)[0] + b'{"torn')
    assert detect(out, elsewhere) == here


def test_the_server_and_its_client_work(tmp_path: Path, elsewhere: Mapping[str, str]) -> None:
    shutil.copytree(ROOT / "models" / "ape", tmp_path / "models" / "ape")
    code = "from curio_serve.server.serve_cli import main; main()"
    command = [sys.executable, "-c", code, str(tmp_path / "models"), "--port", "0", "--metrics-port", "0"]
    with subprocess.Popen(
        command, env=os.environ | elsewhere, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1]
        code = f"""
from curio_serve.client import PoseClient
with PoseClient({address!r}) as client:
    print(len(client.detect("ape", {str(FRAMES[0])!r}, {str(CAMERA)!r}).results[0].detections))
"""
        done = python(code, elsewhere)
        server.terminate()
    assert done.stdout == "1\n", done.stderr
    assert server.returncode == 0


def test_processes_are_unbounded_only_where_the_system_cannot(elsewhere: Mapping[str, str]) -> None:
    code = "from curio_serve.systems import limit_this_process\nlimit_this_process(1 << 28, 5)\nbytearray(1 << 29)"
    assert python(code, {}).returncode == 1, "the limit holds here"
    assert python(code, elsewhere).returncode == 0
