"""What the contract tests look at: the files that git tracks, and nothing else."""

import ast
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def tracked(root: Path) -> list[Path]:
    """Every tracked file that is there, relative to the repository."""
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True).stdout
    files = [Path(name) for name in listing.split("\0") if name and (root / name).is_file()]
    assert Path("pyproject.toml") in files, "git tracks no pyproject.toml: these tests would look at nothing"
    return files


@pytest.fixture(scope="session")
def texts(root: Path, tracked: list[Path]) -> dict[Path, str]:
    """The tracked files that are text, by path."""
    found = {}
    for path in tracked:
        content = (root / path).read_bytes()
        if b"\0" not in content and path.suffix != ".bin":
            found[path] = content.decode()
    return found


@pytest.fixture(scope="session")
def sources(texts: dict[Path, str]) -> dict[Path, str]:
    """Our Python files, generated code left out."""
    return {path: text for path, text in texts.items() if path.suffix == ".py" and "_pb2" not in path.stem}


@pytest.fixture(scope="session")
def trees(sources: dict[Path, str]) -> dict[Path, ast.Module]:
    """Our Python files, parsed."""
    return {path: ast.parse(text, filename=str(path)) for path, text in sources.items()}


@pytest.fixture(scope="session")
def scripts(root: Path) -> dict[str, str]:
    """The console scripts of pyproject.toml: command to ``module:function``."""
    return tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
