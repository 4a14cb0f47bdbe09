"""Flags of parts on a plane that contradict each other or have no effect; no file is read for it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from curio_train.commands.prepare import prepared
from curio_train.commands.train import parse
from curio_train.config import RunConfig
from curio_train.errors import UsageError
from curio_train.worlds.options import CaptureOptions

OPTIONS = CaptureOptions(
    mesh=(Path("wedge.stl"),),
    camera=Path("camera.json"),
    photos=Path("a"),
    background=Path("a/empty.png"),
    plane=Path("views.json"),
    counts=("2",),
    second=Path("b"),
    second_background=Path("b/empty.png"),
)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"plane": None}, "--counts, --second, --second-background: for parts on a plane"),
        (
            {"plane": None, "counts": (), "second": None, "second_background": None, "mesh": ("a/b.stl", "b.stl")},
            "rename one",
        ),
        ({"background": None}, "expected --background"),
        ({"upright": True, "far_m": 2.0}, "--upright, --far-m: for a part in free space"),
        ({"mesh": ("a/part.stl", "b/part.stl"), "counts": ()}, "rename one"),
        ({"counts": ("2", "3")}, "2 --counts for 1 meshes"),
        ({"counts": ("3-2",)}, "--counts 3-2"),
        ({"counts": ("many",)}, "--counts many"),
        ({"counts": ("0",)}, "all scenes are empty"),
        ({"second_background": None}, "belong together"),
        ({"blur_px": 4}, "odd"),
    ],
)
def test_flags_that_contradict_each_other(changes: dict[str, Any], expected: str) -> None:
    if "mesh" in changes:
        changes["mesh"] = tuple(map(Path, changes["mesh"]))
    with pytest.raises(UsageError, match=expected):
        replace(OPTIONS, **changes)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--method", "super"], "--method super: it learns from true poses, and photographs have none"),
        (["--self-training", "0.3"], r"--self-training 0\.3: .* leave it out, or --plane"),
    ],
)
def test_what_photographs_of_a_plane_have_no_use_for(flags: list[str], expected: str, tmp_path: Path) -> None:
    words = ["--mesh", "wedge.stl", "--camera", "camera.json", "--photos", "a", "--background", "a/empty.png"]
    config: RunConfig = parse(["capture", *words, "--plane", "views.json", "--out", "run", *flags]).config
    with pytest.raises(UsageError, match=expected):
        prepared(config, tmp_path, pytest.fail, pytest.fail)
