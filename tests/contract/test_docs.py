"""The documents point at things that exist."""

import os
import re
from pathlib import Path

LINK = re.compile(r"!?\[[^\]]*\]\(<?([^)\s>]+)>?[^)]*\)|<img[^>]*\bsrc=\"([^\"]+)\"")
ELSEWHERE = re.compile(r"^[a-z][a-z0-9+.-]*:|^#")
CODE_BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?<![\w./-])(curio-[a-z]+)(?![\w-])")
MAKE_TARGET = re.compile(r"(?:`|^\$? *)make ([a-z]+)\b", re.MULTILINE)
TARGET = re.compile(r"^([a-z]+):", re.MULTILINE)
DISTRIBUTION = "curio-pose"


def documents(texts: dict[Path, str]) -> dict[Path, str]:
    """The Markdown files."""
    found = {path: text for path, text in texts.items() if path.suffix == ".md"}
    assert Path("README.md") in found
    return found


def test_relative_links_resolve(root: Path, texts: dict[Path, str], tracked: list[Path]) -> None:
    present = {(root / path).resolve() for path in tracked}
    present |= {folder for path in present for folder in path.parents}
    dead = []
    for path, text in documents(texts).items():
        for match in LINK.finditer(CODE_BLOCK.sub("", text)):
            target = match[1] or match[2]
            if not ELSEWHERE.match(target) and (root / path.parent / target.split("#")[0]).resolve() not in present:
                dead.append(f"{path}: {target}")
    assert not dead, dead


def _anchors(text: str) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.+)$", CODE_BLOCK.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_anchors_exist(root: Path, texts: dict[Path, str]) -> None:
    dead = []
    for path, text in documents(texts).items():
        for match in LINK.finditer(CODE_BLOCK.sub("", text)):
            file, _, anchor = (match[1] or match[2]).partition("#")
            target = Path(os.path.normpath(path.parent / file)) if file else path
            if anchor and target in texts and target.suffix == ".md" and anchor not in _anchors(texts[target]):
                dead.append(f"{path}: {match[1]}")
    assert not dead, dead


def test_named_commands_exist(texts: dict[Path, str], scripts: dict[str, str]) -> None:
    named = {(command, str(path)) for path, text in documents(texts).items() for command in COMMAND.findall(text)}
    assert named, "no document names a command"
    unknown = sorted(pair for pair in named if pair[0] not in {*scripts, DISTRIBUTION})
    assert not unknown


def test_named_make_targets_exist(root: Path, texts: dict[Path, str]) -> None:
    targets = set(TARGET.findall((root / "Makefile").read_text()))
    named = {(target, str(path)) for path, text in documents(texts).items() for target in MAKE_TARGET.findall(text)}
    assert named, "no document names a make target"
    unknown = sorted(pair for pair in named if pair[0] not in targets)
    assert not unknown
