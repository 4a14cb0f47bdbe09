"""The import layers of pyproject.toml hold, and hold every module."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = {
    "curio_proto": "proto/curio_proto",
    "curio_serve": "serving/curio_serve",
    "curio_train": "training/curio_train",
}


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """What import-linter says of the packages in a folder, or where it has none, of those that are installed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    linter = Path(sys.executable).with_name("lint-imports")
    command = [linter, "--no-cache"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_layers_hold(root: Path) -> None:
    result = lint(root)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("package", ["curio_serve", "curio_serve.batch", "curio_train"])
def test_a_module_in_no_layer_is_refused(package: str, root: Path, tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").symlink_to(root / "pyproject.toml")
    for name, folder in PACKAGES.items():
        mirror(root / folder, tmp_path / name)
    (tmp_path / package.replace(".", "/") / "newcomer.py").touch()
    result = lint(tmp_path)
    assert result.returncode == 1, result.stderr
    assert "newcomer" in result.stdout


def mirror(folder: Path, copy: Path) -> None:
    """The same folders, with links to the same modules."""
    copy.mkdir()
    for entry in folder.iterdir():
        if entry.is_dir():
            mirror(entry, copy / entry.name)
        elif entry.suffix == ".py":
            (copy / entry.name).symlink_to(entry)
