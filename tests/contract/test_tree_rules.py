"""The rules of the house (CONTRIBUTING.md) that a machine can check."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

MAX_FILE_LINES = 350
MAX_FUNCTION_LINES = 80
MAX_FOLDER_FILES = 15
MAX_FOLDER_LINES = 2600
CODE = {"training", "serving", "proto", "benchmarks"}
# The renderer is one thing in many short files.
FULL_FOLDER = Path("training/curio_train/rendering")
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "common", "misc"}
BROAD = {"Exception", "BaseException"}
# Where a call ends: its caller gets an answer to any fault of ours.
BROAD_PLACE = (Path("serving/curio_serve/api/status.py"), "record")
# This file spells out what it forbids.
EXEMPT = Path("tests/contract/test_tree_rules.py")
MACHINE_PATH = re.compile(r"(?<![\w.*])/(home/\w+|root|Users/\w+|work)/|\bfile:///|(?<!\w)\.\./shared\b")
REGISTRY_HOST = re.compile(r"\b(pypi|pythonhosted|download\.pytorch|deb\.debian)\.org\b|\b(ghcr|docker)\.io\b")
UNFINISHED = re.compile(r"\b(TODO|FIXME|XXX|NotImplementedError)\b")


def lines_matching(texts: dict[Path, str], pattern: re.Pattern[str]) -> list[str]:
    """``file:line: text`` of every match, this file and generated code left out."""
    return [
        f"{path}:{number}: {line.strip()[:100]}"
        for path, text in texts.items()
        if path != EXEMPT and "_pb2" not in path.stem
        for number, line in enumerate(text.splitlines(), 1)
        if pattern.search(line)
    ]


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Every function and method."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def is_broad(handler: ast.ExceptHandler) -> bool:
    """Whether it catches everything."""
    if handler.type is None:
        return True
    caught = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(isinstance(name, ast.Name) and name.id in BROAD for name in caught)


def test_files_are_short(sources: dict[Path, str]) -> None:
    long = {str(path): n for path, text in sources.items() if (n := len(text.splitlines())) > MAX_FILE_LINES}
    assert not long, f"more than {MAX_FILE_LINES} lines: {long}"


def test_folders_are_small(sources: dict[Path, str]) -> None:
    modules: dict[Path, list[int]] = {}
    for path, text in sources.items():
        if path.parts[0] in CODE and path.name != "__init__.py" and path.parent != FULL_FOLDER:
            modules.setdefault(path.parent, []).append(len(text.splitlines()))
    assert len(modules) > 30, "these are not all folders"
    full = {
        str(folder): (len(lines), sum(lines))
        for folder, lines in modules.items()
        if len(lines) > MAX_FOLDER_FILES or sum(lines) > MAX_FOLDER_LINES
    }
    assert not full, f"more than {MAX_FOLDER_FILES} modules or {MAX_FOLDER_LINES} lines: {full}"


def test_functions_are_short(trees: dict[Path, ast.Module]) -> None:
    lengths = {
        f"{path}:{function.lineno} {function.name}": (function.end_lineno or function.lineno) - function.lineno + 1
        for path, tree in trees.items()
        for function in functions(tree)
    }
    long = {where: length for where, length in lengths.items() if length > MAX_FUNCTION_LINES}
    assert not long, f"more than {MAX_FUNCTION_LINES} lines: {long}"


def test_modules_are_named_after_what_they_hold(sources: dict[Path, str]) -> None:
    vague = [str(path) for path in sources if VAGUE_NAMES & set(path.with_suffix("").parts)]
    assert not vague


def test_no_error_is_swallowed_wholesale(trees: dict[Path, ast.Module]) -> None:
    allowed = {
        node
        for function in functions(trees[BROAD_PLACE[0]])
        if function.name == BROAD_PLACE[1]
        for node in ast.walk(function)
    }
    broad = [
        f"{path}:{node.lineno}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ExceptHandler) and is_broad(node) and node not in allowed
    ]
    assert not broad, f"catch what you can name: {broad}"


@pytest.mark.parametrize("pattern", [UNFINISHED, REGISTRY_HOST], ids=["unfinished", "registry-host"])
def test_no_text_holds(texts: dict[Path, str], pattern: re.Pattern[str]) -> None:
    found = lines_matching(texts, pattern)
    assert not found, "\n".join(found)


def test_no_text_names_a_machine(root: Path, texts: dict[Path, str]) -> None:
    anywhere = re.compile(f"{MACHINE_PATH.pattern}|{re.escape(str(root))}/")
    found = lines_matching({path: text for path, text in texts.items() if path != Path(".ci/run")}, anywhere)
    assert not found, "\n".join(found)


def test_nothing_huge_is_tracked(root: Path, tracked: list[Path]) -> None:
    huge = {str(path): size for path in tracked if (size := (root / path).stat().st_size) > 12 * 10**6}
    assert not huge, f"more than 12 MB, which a model of eight objects needs: {huge}"
