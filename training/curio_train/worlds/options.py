"""Options of each world, as plain data without torch: flags of the command line and keys of ``config.json``."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Suppress

from curio_train.config import MethodName, WorldOptions
from curio_train.errors import UsageError

_TWO_STAGE_RECIPE: Mapping[str, Any] = {
    "matrix_learning_rate": 0.01,
    "learning_rate": 1e-3,
    "warm_up_steps": 100,
    "gradient_clip": 1.0,
    "budget_images": 240_000,
    "self_training": 0.5,
}

LOCATOR_RECIPE: Mapping[str, Any] = {"batch_size": 16, "micro_batch_size": 16, "budget_images": 19_200}
"""Hyperparameters of worlds where a locator is trained: its trunk is frozen, so it learns from few images."""


def srgb_of(color: str) -> tuple[float, float, float]:
    """A colour given as #rrggbb, in [0, 1].

    Raises:
        UsageError: It is not written so.
    """
    digits = color.removeprefix("#")
    try:
        channels = bytes.fromhex(digits)
    except ValueError:
        channels = b""
    if len(channels) != 3 or len(digits) != 6:
        raise UsageError(f"--paint {color}: expected a colour in sRGB such as '#8a6f4c'")
    red, green, blue = (channel / 255 for channel in channels)
    return red, green, blue


def _make_absolute(options: WorldOptions, *names: str) -> None:
    """Because a run may be evaluated and exported from other folders than it was started in."""
    for name in names:
        if isinstance(path := getattr(options, name), Path):
            object.__setattr__(options, name, path.absolute())
        elif isinstance(path, tuple):
            object.__setattr__(options, name, tuple(one.absolute() for one in path))


@dataclass(frozen=True)
class CirclesOptions(WorldOptions):
    """A red circle of constant size on black: 2D position alone. Needs no data."""

    is_flat: ClassVar[bool] = True


@dataclass(frozen=True)
class SpheresOptions(WorldOptions):
    """Three spheres on black: 3D position and colour of each. Needs no data."""


@dataclass(frozen=True)
class ChairsOptions(WorldOptions):
    """Five chairs on the ground: position and yaw of each. Needs no data."""


@dataclass(frozen=True)
class VariedOptions(WorldOptions):
    """Two to five spheres on black: position, colour and confidence of each. Needs no data."""


@dataclass(frozen=True)
class MultiOptions(WorldOptions):
    """Two each of the letters W, X, Y, Z on the ground: position, yaw and colour of each. Needs no data."""


@dataclass(frozen=True)
class LightOptions(WorldOptions):
    """Two to ten capsules, boxes and cones on the ground: all of the above, and where the sun is. Needs no data."""


ALL_CLASSES = "all"
"""Names every object of a data set."""


def _is_several(class_name: str) -> bool:
    return class_name == ALL_CLASSES or "," in class_name


@dataclass(frozen=True)
class LinemodOptions(WorldOptions):
    """Objects of the LineMOD data set in six degrees of freedom, over cluttered backgrounds."""

    default_method: ClassVar[MethodName] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _TWO_STAGE_RECIPE

    class_name: Annotated[str, tyro.conf.arg(name="class")]
    """The object: ape, benchvise, can, cat, … Several, as in ape,can, or all of the data set make one detector with a
    slot for each."""
    data: Path | None = None
    """Folder in BOP's layout (lm or lmo) with models, models_info.json and camera.json. Without it LineMOD's own are
    downloaded, after a question."""
    backgrounds: Path | None = None
    """Folder of photographs for backgrounds; without it clutter is rendered."""
    photos: Path | None = None
    """Folder of unlabelled frames of the data set's camera. Towards the end of training the detector learns from them,
    with the poses that it estimates there itself (--self-training, which is 0 without them). Frames of one scene from
    several viewpoints, in the order of their names, correct each other; only --two-stage learns from others, too."""
    views: Path | None = None
    """File with the camera poses of --photos, in metres, as capture --calibrate --views-out writes it. Without it they
    are recovered from the photographs, and their scale from the estimated object poses."""
    gaze: Annotated[
        FlagCreatePairsOff[bool],
        tyro.conf.arg(aliases=["--one-stage"], help_behavior_hint="(default: a trained locator, and templates)"),
    ] = True
    """Train the paper's network, whose one encoder sees the frame squeezed to 128x128."""
    two_stage: FlagCreatePairsOff[bool] = False
    """Train a detector of one object that finds it in the whole frame, then regresses its pose from a crop. With one
    class, methods other than sleep and templates do so unless --one-stage is given. Without it a trained locator finds
    objects, and templates, drawn beforehand, tell their poses: photographs are read better so."""
    download: FlagCreatePairsOff[bool] = False
    """Without --data, fetch LineMOD's meshes and cameras from BOP's repository into --cache, once, without asking."""

    def __post_init__(self) -> None:
        """Make paths absolute, and refuse what contradicts itself."""
        _make_absolute(self, "data", "backgrounds", "photos", "views")
        if self.views is not None and self.photos is None:
            raise UsageError(f"--views {self.views}: found no photographs that these poses are of; expected --photos")
        if not self.gaze and self.photos is not None:
            raise UsageError(
                f"--photos {self.photos}: the paper's network does not learn from them; leave out --one-stage"
            )
        names = str(self.class_name).split(",")  # which is a marker where it is left out
        if len(set(names)) < len(names):
            raise UsageError(f"--class {self.class_name}: found a class twice, expected each once")
        if not self.gaze and self.two_stage:
            raise UsageError("found --one-stage and --two-stage, expected one network")
        if (self.two_stage or not self.gaze) and self.names_several:
            flag = "--two-stage" if self.two_stage else "--one-stage"
            raise UsageError(f"{flag}: finds one object, found --class {self.class_name}; expected one class")

    @property
    def names_several(self) -> bool:
        """Whether several objects are asked for."""
        return _is_several(self.class_name)

    @classmethod
    def upgraded(cls, stored: Mapping[str, Any]) -> Mapping[str, Any]:
        """Options of a stored configuration; those that are older than --two-stage always had two for one object."""
        is_two_stage = stored.get("gaze", True) and not _is_several(str(stored.get("class_name")))
        return {"two_stage": is_two_stage, **stored}


@dataclass(frozen=True)
class CaptureOptions(WorldOptions):
    """A part of your own, from its CAD file, in six degrees of freedom. Camera: --calibrate; photos: --assistant.

    With --calibrate: find out its camera instead. With --assistant: take its photographs with a camera on this machine.

    With --plane: parts of one or more kinds on a table or floor, as many of each as --counts says.
    """

    default_method: ClassVar[MethodName] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _TWO_STAGE_RECIPE

    mesh: tuple[Path, ...]
    """Mesh file: STL, OBJ, PLY, GLB, glTF, OFF, STEP or IGES. Several make one detector with a slot for each, or, with
    --plane, for each kind of part."""
    camera: Path
    """Camera file of the photographs: camera JSON, BOP's camera.json, or YAML of OpenCV or ROS."""
    photos: Path
    """Folder of unlabelled photographs. They are checked against the camera, show the part's colour, and the report
    draws the estimated poses over them. Towards the end of training the network of one part learns from them, with the
    poses that it estimates there itself (--self-training). With --plane, the default method (sleep) takes from them
    where parts lie, and --method our, noncur, wake_sleep or wake_sleep_critic learns from them from the beginning."""
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh file's coordinates; the file's own, or metres, unless given."""
    body: str | None = None
    """Name of the one body of a STEP or IGES file to take, in its own frame; all of them, as placed, unless given."""
    background: Path | None = None
    """Photograph of the empty scene, taken as the others were."""
    backgrounds: Path | None = None
    """Folder of photographs for backgrounds, if the scene changes; without it and --background clutter is rendered."""
    paint: str | None = None
    """Colour of a part whose mesh has none, sRGB, such as '#8a6f4c'. Unless given, it is estimated where the
    photographs differ from --background; if it cannot be, the part is learned in any colour, and several parts and
    --method templates in grey."""
    near_m: float = 0.3
    """Smallest distance of the part's middle along the optical axis, metres."""
    far_m: float = 1.0
    """Largest such distance, metres."""
    upright: FlagCreatePairsOff[bool] = False
    """The part is only seen from above (z of the mesh is up, camera rolled by up to 45 degrees), not from any side."""
    plane: Path | None = None
    """JSON file with cam_from_world of --background, y up, in metres, as --calibrate --views-out writes it: parts lie
    on the plane y = 0."""
    counts: tuple[str, ...] = ()
    """With --plane, how many there are of each mesh, or from how many to how many: --counts 3 or --counts 0-4 1-2. One
    of each unless given."""
    up: Literal["x", "y", "z"] = "z"
    """With --plane, axis of the meshes that points up."""
    lying: FlagCreatePairsOff[bool] = False
    """With --plane, parts lie any way, not upright and rotated about --up alone."""
    held_out: Path | None = None
    """With --plane, folder of further photographs to judge by instead of --photos."""
    second: Path | None = None
    """With --plane, folder of photographs of those same scenes, under the same names, by a second camera of the same
    kind; the model is judged by them, too."""
    second_background: Path | None = None
    """Photograph of the empty scene by the second camera; the --plane file has its cam_from_world, too."""
    blur_px: int = 9
    """With --plane, side of the Gaussian filter over images and renderings before they are compared (paper: 9); 1
    compares them as they are."""
    centered: Suppress[bool] = True
    """Whether the network reads where the part's middle is; networks of older versions read where the file's origin
    is."""
    mesh_sha256: Suppress[tuple[str, ...]] = ()
    """SHA-256 of each mesh file as training began, hexadecimal: a run is of these meshes. Empty: in older runs."""
    judged: Suppress[tuple[str, ...]] = ()
    """File names of the photographs that judge the model, chosen as training begins: photographs that are added later
    change nothing about which it never learns from. Empty: in older runs, and with --plane."""

    def __post_init__(self) -> None:
        """Make paths absolute, and refuse what contradicts itself."""
        _make_absolute(self, "mesh", "camera", "photos", "background", "backgrounds", "plane", "held_out")
        _make_absolute(self, "second", "second_background")
        if self.background is not None and self.backgrounds is not None:
            raise UsageError(
                "--background and --backgrounds exclude each other: one photograph of the empty scene, or a folder of "
                "other scenes"
            )
        if not 0 < self.near_m < self.far_m:
            raise UsageError(
                f"found --near-m {self.near_m:g} and --far-m {self.far_m:g}, expected 0 < near < far, in metres"
            )
        if self.paint is not None:
            srgb_of(self.paint)
        if self.body is not None and isinstance(self.mesh, tuple) and len(self.mesh) != 1:
            raise UsageError(f"--body {self.body}: expected one --mesh with it, found {len(self.mesh)}")
        if self.plane is None:
            self._check_without_plane()
        else:
            self._check_with_plane(self.plane)

    @classmethod
    def upgraded(cls, stored: Mapping[str, Any]) -> Mapping[str, Any]:
        """Options of a stored configuration; those that are older than ``centered`` are of the file's origin."""
        return {"centered": False, **stored}

    def sha256_of(self, number: int) -> str | None:
        """SHA-256 of a mesh file as training began; None: not known."""
        return self.mesh_sha256[number] if self.mesh_sha256 else None

    @property
    def names_several(self) -> bool:
        """Whether several parts in free space are asked for."""
        return self.plane is None and len(self.mesh) > 1

    @property
    def count_ranges(self) -> list[tuple[int, int]]:
        """Minimum and maximum number of each mesh.

        Raises:
            UsageError: They are not numbers, or not as many as meshes.
        """
        counts = self.counts or ("1",) * len(self.mesh)
        if len(counts) != len(self.mesh):
            raise UsageError(f"found {len(counts)} --counts for {len(self.mesh)} meshes, expected one each")
        return [_count_range(count) for count in counts]

    def _check_without_plane(self) -> None:
        names = ("counts", "up", "lying", "held_out", "second", "second_background", "blur_px")
        if flags := self._given_flags(names):
            raise UsageError(f"{flags}: for parts on a plane; expected --plane as well")
        if isinstance(self.mesh, tuple):
            self._check_names()

    def _check_names(self) -> None:
        if len({file.stem for file in self.mesh}) < len(self.mesh):
            raise UsageError(f"--mesh {' '.join(map(str, self.mesh))}: parts are named after their files: rename one")
        if odd := next((file for file in self.mesh if "," in file.stem), None):
            raise UsageError(f"--mesh {odd}: parts are named after their files, and --objects has commas between names")

    def _given_flags(self, names: tuple[str, ...]) -> str:
        """The flags of these fields whose values are not the defaults."""
        given = [name for name in names if getattr(self, name) != getattr(CaptureOptions, name)]
        return ", ".join(f"--{name.replace('_', '-')}" for name in given)

    def _check_with_plane(self, plane: Path) -> None:
        if self.background is None:
            raise UsageError(f"--plane {plane}: expected --background, a photograph of it without parts, as well")
        if flags := self._given_flags(("backgrounds", "paint", "upright", "near_m", "far_m")):
            raise UsageError(f"{flags}: for a part in free space; leave it out, or --plane {plane}")
        self._check_names()
        if (self.second is None) != (self.second_background is None):
            raise UsageError("--second and --second-background belong together: expected both, or neither")
        if self.blur_px < 1 or self.blur_px % 2 == 0:
            raise UsageError(f"--blur-px {self.blur_px}: expected an odd number of pixels, 1 for none")
        if max(most for _, most in self.count_ranges) < 1:
            raise UsageError(f"--counts {' '.join(self.counts)}: all scenes are empty; expected one part or more")


def _count_range(text: str) -> tuple[int, int]:
    least, dash, most = text.partition("-")
    if not (least.isdigit() and (most.isdigit() or not dash)) or (dash and int(most) < int(least)):
        raise UsageError(f"--counts {text}: expected a number such as 3, or a range such as 0-4")
    return int(least), int(most or least)
