"""Flags of parts on a plane that contradict each other; no file is read for it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
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
