"""What ``make dist`` builds: the source distribution, and the wheel made of it, in an environment of its own."""

import json
import subprocess
import sys
import tarfile
import tomllib
from email import message_from_string
from email.message import Message
from pathlib import Path
from typing import Any

import pytest

PROBE = """
import importlib.metadata as metadata, json
from pathlib import Path
import curio_proto, curio_serve.errors, curio_serve.systems
found = metadata.distribution("curio-pose")
commands = {entry.name: entry.value for entry in found.entry_points}
files = [str(file) for file in found.files]
print(json.dumps({"metadata": str(found.read_text("METADATA")), "commands": commands, "files": files}))
"""


def run(*command: str | Path, folder: Path) -> str:
    done = subprocess.run(list(map(str, command)), cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with both."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, root, folder=folder)
    return folder


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the wheel says and holds once it is installed, without its dependencies, in a fresh environment."""
    folder = tmp_path_factory.mktemp("fresh")
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", folder=folder)
    python, (wheel,) = folder / "venv" / "bin" / "python", built.glob("*.whl")
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, folder=folder)
    return dict(json.loads(run(python, "-I", "-c", PROBE, folder=folder)))


@pytest.fixture(scope="module")
def project(root: Path) -> dict[str, Any]:
    return dict(tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"])


@pytest.fixture(scope="module")
def metadata(installed: dict[str, Any]) -> Message:
    return message_from_string(installed["metadata"])


def test_both_pass_twine(built: Path) -> None:
    files = sorted(built.iterdir())
    assert [file.suffix for file in files] == [".whl", ".gz"]
    said = run(sys.executable, "-m", "twine", "--no-color", "check", "--strict", *files, folder=built)
    assert said.count("PASSED") == 2


def test_the_metadata_is_the_projects(metadata: Message, project: dict[str, Any]) -> None:
    assert (metadata["Name"], metadata["Version"]) == (project["name"], project["version"])
    assert metadata["Requires-Python"] == project["requires-python"]
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert set(metadata.get_all("Provides-Extra", [])) == project["optional-dependencies"].keys()
    required = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert len(required) == len(project["dependencies"])
    systems = [line for line in metadata.get_all("Classifier", []) if line.startswith("Operating System")]
    assert len(systems) == 3


def test_the_wheel_holds_packages_and_commands_and_nothing_else(
    installed: dict[str, Any], project: dict[str, Any]
) -> None:
    assert installed["commands"] == project["scripts"]
    tops = {Path(file).parts[0] for file in installed["files"] if not file.startswith("..")}
    packages = {"curio_train", "curio_serve", "curio_proto"}
    assert {top for top in tops if not top.endswith(".dist-info")} == packages
    assert "curio_train/evaluation/reporting/report.html.jinja" in installed["files"]
    assert any(file.endswith("licenses/LICENSE") for file in installed["files"])


def test_the_source_distribution_is_enough_to_build_the_wheel_and_holds_no_tests(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        tops = {Path(name).parts[1] for name in file.getnames() if len(Path(name).parts) > 1}
    assert {"training", "serving", "proto", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"} <= tops
    assert not {"tests", "models", "benchmarks"} & tops
