"""Importing does nothing but define, and the heavy packages wait until a command needs them."""

import ast
import importlib
import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

TRAINING_ONLY = {"curio_train", "torch", "mitsuba", "drjit", "onnx", "onnxscript", "trimesh"}
TRAINING_EXTRAS = {"train", "usd", "rerun", "cad", "capture", "dev"}
HEAVY = TRAINING_ONLY - {"curio_train"} | {"onnxruntime", "cv2", "scipy", "skimage", "matplotlib", "tensorboard"}

# Imports the modules named on its command line, then tells what that changed besides defining them.
PROBE = """
import importlib, json, logging, os, signal, sys, threading
environment, handlers = dict(os.environ), [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
for name in sys.argv[1:]:
    importlib.import_module(name)
changes = []
if handlers != [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]:
    changes.append("signal handlers")
if logging.getLogger().handlers:
    changes.append("root logger's handlers")
if threading.active_count() != 1:
    changes.append(f"threads {threading.enumerate()}")
changed = {name for name, _ in os.environ.items() ^ environment.items()} - {"LD_LIBRARY_PATH"}  # OpenCV sets that
if changed:
    changes.append(f"environment {changed}")
if "mitsuba" in sys.modules and sys.modules["mitsuba"].variant() is not None:
    changes.append("mitsuba's variant")
loaded = sorted({name.partition(".")[0] for name, module in sys.modules.items() if module is not None})
print(json.dumps({"loaded": loaded, "changes": changes}))
"""


def modules(root: Path, package: str) -> list[str]:
    """Dotted names of every module below ``package``, a path such as ``serving/curio_serve``."""
    base = root / package
    files = sorted(base.rglob("*.py"))
    names = [".".join(file.relative_to(base.parent).with_suffix("").parts) for file in files]
    assert names, f"no module below {package}"
    return [name.removesuffix(".__init__") for name in names]


def probe(names: list[str], folder: Path) -> dict[str, list[str]]:
    """Import ``names`` in a fresh interpreter whose working folder is ``folder``."""
    command = [sys.executable, "-c", PROBE, *names]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    *printed, report = result.stdout.splitlines()
    assert not printed, "importing printed something"
    return json.loads(report)


@pytest.mark.parametrize("package", ["serving/curio_serve", "training/curio_train"])
def test_importing_has_no_side_effect(root: Path, tmp_path: Path, package: str) -> None:
    assert probe(modules(root, package), tmp_path)["changes"] == []
    assert list(tmp_path.iterdir()) == [], "importing wrote files"


def test_serving_imports_nothing_of_training(root: Path, tmp_path: Path) -> None:
    loaded = probe(modules(root, "serving/curio_serve"), tmp_path)["loaded"]
    assert not TRAINING_ONLY & set(loaded)


def test_serving_needs_what_its_install_brings(root: Path) -> None:
    """What a module of serving imports at its head comes with the base install, or with an extra of serving's own."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [
        *project["dependencies"],
        *(line for name, lines in extras.items() if name not in TRAINING_EXTRAS for line in lines),
    ]
    brought = {re.split(r"[^A-Za-z0-9_.-]", line)[0].lower() for line in declared}
    of_module = importlib.metadata.packages_distributions()
    missing = {
        f"{file.relative_to(root)}: {name}"
        for file in sorted((root / "serving").rglob("*.py"))
        for name in head_imports(ast.parse(file.read_text()))
        if name not in sys.stdlib_module_names and not name.startswith("curio_")
        if not brought & {distribution.lower().replace("_", "-") for distribution in of_module[name]}
    }
    assert not missing


def head_imports(tree: ast.Module) -> set[str]:
    """Packages that a module imports as it is imported itself; not those for type checkers or within functions."""
    plain = {name.name for node in tree.body if isinstance(node, ast.Import) for name in node.names}
    named = {node.module for node in tree.body if isinstance(node, ast.ImportFrom) and node.module}
    return {name.partition(".")[0] for name in plain | named}


def test_messages_need_protobuf_and_grpc_alone(root: Path, tmp_path: Path) -> None:
    loaded = probe(modules(root, "proto/curio_proto"), tmp_path)["loaded"]
    assert not (HEAVY | {"curio_train", "curio_serve", "numpy"}) & set(loaded)


def test_every_command_is_a_function(scripts: dict[str, str]) -> None:
    broken = {}
    for command, target in scripts.items():
        module, _, function = target.partition(":")
        if not callable(getattr(importlib.import_module(module), function, None)):
            broken[command] = target
    assert scripts
    assert not broken


def test_command_lines_load_no_heavy_package(scripts: dict[str, str], tmp_path: Path) -> None:
    command_lines = sorted({target.partition(":")[0] for target in scripts.values()})
    heavy = {name: sorted(HEAVY & set(probe([name], tmp_path)["loaded"])) for name in command_lines}
    assert not any(heavy.values()), heavy
