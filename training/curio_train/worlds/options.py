"""What a user may choose about each world, as plain data without torch: the command line's flags."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

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


def _make_absolute(options: WorldOptions, *names: str) -> None:
    """A run is evaluated and exported from other folders than it was started in."""
    for name in names:
        if isinstance(path := getattr(options, name), Path):
            object.__setattr__(options, name, path.absolute())
        elif isinstance(path, tuple):
            object.__setattr__(options, name, tuple(one.absolute() for one in path))


@dataclass(frozen=True)
class CirclesOptions(WorldOptions):
    """A red circle of constant size on black: 2D position alone. Needs no data."""


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


@dataclass(frozen=True)
class LinemodOptions(WorldOptions):
    """One object of the LineMOD data set in six degrees of freedom, over cluttered backgrounds.

    Attributes:
        class_name: ape, benchvise, can, cat, …: the object.
        data: Folder in BOP's layout (lm or lmo) with models, models_info.json and camera.json.
        download: Without --data, fetch LineMOD from BOP's repository into the cache folder, once; some gigabytes.
        backgrounds: Folder of photographs to see the object in front of; clutter is rendered where none is given.
        photos: Folder of unlabelled frames of the data set's camera, from which a gaze learns towards the end, with the
            poses that it reads there itself (--self-training). Frames that show one scene from several sides, in the
            order of their names, correct each other. None are used unless given.
        views: File with where the camera of --photos stood, in metres, as capture --calibrate --views-out writes it.
            Found from the photographs unless given, and their scale from what is read in them.
        gaze: Look twice: at the whole frame for the place, at a crop around it for the rest. The other way, the paper's
            one encoder sees the frame squeezed to 128x128.
    """

    default_method: ClassVar[MethodName] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _TWO_STAGE_RECIPE

    class_name: Annotated[str, tyro.conf.arg(name="class")]
    data: Path | None = None
    backgrounds: Path | None = None
    photos: Path | None = None
    views: Path | None = None
    gaze: tyro.conf.FlagCreatePairsOff[bool] = True
    download: tyro.conf.FlagCreatePairsOff[bool] = False

    def __post_init__(self) -> None:
        """Make paths absolute."""
        _make_absolute(self, "data", "backgrounds", "photos", "views")


@dataclass(frozen=True)
class CaptureOptions(WorldOptions):
    """A part of your own, from its CAD file, in six degrees of freedom. With --calibrate: find out its camera instead.

    With --plane: one or more parts on a table or floor, learned from the photographs.

    Attributes:
        mesh: Mesh file: STL, OBJ, PLY, GLB, glTF or OFF; on a plane as many as there are kinds of parts.
        camera: Camera file of the photographs: camera JSON, or BOP's camera.json.
        photos: Folder of unlabelled photographs. They are checked against the camera, tell the part's colour, and the
            report shows what was found in them. Towards the end of training they are learned from, with the poses that
            the network itself reads in them (--self-training); on a plane from the beginning.
        mesh_unit: Unit of the mesh file's coordinates; the file's own, or metres, unless given.
        background: Photograph of the empty scene, taken as the others were.
        backgrounds: Folder of photographs to see the part in front of, where the scene changes; clutter is rendered
            where neither is given.
        paint: Colour of a part whose mesh has none, sRGB, such as '#8a6f4c'. Found where the photographs differ from
            --background unless given; where neither tells it, the part is learned in any colour.
        near_m: Least distance of the part's origin along the optical axis, metres.
        far_m: Largest.
        upright: The part is only seen from above (z of the mesh is up, rolled by up to 45 degrees), not from any side.
        plane: JSON file with cam_from_world of the plate --background, y up, in metres, as --calibrate --views-out
            writes it: parts lie on the plane y = 0.
        counts: On a plane, how many there are of each mesh, or from how many to how many: --counts 3 or --counts 0-4
            1-2. One of each unless given.
        up: Axis of the meshes that points up on the plane.
        lying: Parts lie on the plane any way, not upright and turned about --up alone.
        held_out: Folder of further photographs on the plane, to judge by instead of --photos.
        second: Folder of photographs of those same scenes, under the same names, from a second camera of the same kind:
            what was learned is judged by them.
        second_background: The empty scene from there; --plane has its cam_from_world, too.
        blur_px: On a plane, side of the Gaussian filter over images and renderings where they are compared (paper: 9);
            1 compares them as they are.
    """

    default_method: ClassVar[MethodName] = "sleep"
    default_recipe: ClassVar[Mapping[str, Any]] = _TWO_STAGE_RECIPE

    mesh: tuple[Path, ...]
    camera: Path
    photos: Path
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    background: Path | None = None
    backgrounds: Path | None = None
    paint: str | None = None
    near_m: float = 0.3
    far_m: float = 1.0
    upright: tyro.conf.FlagCreatePairsOff[bool] = False
    plane: Path | None = None
    counts: tuple[str, ...] = ()
    up: Literal["x", "y", "z"] = "z"
    lying: tyro.conf.FlagCreatePairsOff[bool] = False
    held_out: Path | None = None
    second: Path | None = None
    second_background: Path | None = None
    blur_px: int = 9

    def __post_init__(self) -> None:
        """Make paths absolute, and refuse what contradicts itself."""
        _make_absolute(self, "mesh", "camera", "photos", "background", "backgrounds", "plane", "held_out")
        _make_absolute(self, "second", "second_background")
        if self.background is not None and self.backgrounds is not None:
            raise UsageError("--background and --backgrounds exclude each other: a plate, or a folder of other scenes")
        if not 0 < self.near_m < self.far_m:
            raise UsageError(
                f"found --near-m {self.near_m:g} and --far-m {self.far_m:g}, expected 0 < near < far, in metres"
            )
        if self.plane is None:
            self._refuse_without_plane()
        else:
            self._refuse_with_plane()

    @property
    def amounts(self) -> list[tuple[int, int]]:
        """The fewest and the most there are of each mesh.

        Raises:
            UsageError: They are no numbers, or not as many as meshes.
        """
        counts = self.counts or ("1",) * len(self.mesh)
        if len(counts) != len(self.mesh):
            raise UsageError(f"found {len(counts)} --counts for {len(self.mesh)} meshes, expected one each")
        return [_amount(count) for count in counts]

    def _refuse_without_plane(self) -> None:
        names = ("counts", "up", "lying", "held_out", "second", "second_background", "blur_px")
        if flags := self._flags_of(names):
            raise UsageError(f"{flags}: for parts on a plane, which --plane has to say; expected it as well")
        if isinstance(self.mesh, tuple) and len(self.mesh) != 1:
            raise UsageError(
                f"--mesh names {len(self.mesh)} files; several parts are learned on a plane alone: give --plane, or "
                "train a model for each"
            )

    def _flags_of(self, names: tuple[str, ...]) -> str:
        """Those of the flags that were given another value than the usual one."""
        given = [name for name in names if getattr(self, name) != getattr(CaptureOptions, name)]
        return ", ".join(f"--{name.replace('_', '-')}" for name in given)

    def _refuse_with_plane(self) -> None:
        if self.background is None:
            raise UsageError(f"--plane {self.plane}: expected --background, a photograph of it without parts, as well")
        if flags := self._flags_of(("backgrounds", "paint", "upright", "near_m", "far_m")):
            raise UsageError(f"{flags}: for a part in free space; leave it out, or --plane {self.plane}")
        if len({file.stem for file in self.mesh}) < len(self.mesh):
            raise UsageError(f"--mesh {' '.join(map(str, self.mesh))}: parts are named after their files: rename one")
        if (self.second is None) != (self.second_background is None):
            raise UsageError("--second and --second-background belong together: expected both, or neither")
        if self.blur_px < 1 or self.blur_px % 2 == 0:
            raise UsageError(f"--blur-px {self.blur_px}: expected an odd number of pixels, 1 for none")
        if max(most for _, most in self.amounts) < 1:
            raise UsageError(f"--counts {' '.join(self.counts)}: there is never anything; expected a part or more")


def _amount(text: str) -> tuple[int, int]:
    fewest, dash, most = text.partition("-")
    if not (fewest.isdigit() and (most.isdigit() or not dash)) or (dash and int(most) < int(fewest)):
        raise UsageError(f"--counts {text}: expected a number such as 3, or the fewest and the most, such as 0-4")
    return int(fewest), int(most or fewest)
