"""The bracket of :mod:`synthetic_captures.scenes` as an engineer has it: a STEP file, drawn with OpenCASCADE."""

from pathlib import Path

from OCP.BRepAlgoAPI import BRepAlgoAPI_Fuse
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt
from OCP.IFSelect import IFSelect_RetDone
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.TopoDS import TopoDS_Shape

from synthetic_captures.scenes import BRACKET_BLOCKS, BRACKET_MIDDLE, BRACKET_PIN

_MM = 1000.0


def write_bracket(path: Path) -> None:
    """Write it, in millimetres and in the frame of :func:`~synthetic_captures.scenes.bracket`.

    Args:
        path: The file.

    Raises:
        OSError: It cannot be written.
    """
    whole: TopoDS_Shape | None = None
    for extents, centre in BRACKET_BLOCKS:
        corner = [c - e / 2 - m for c, e, m in zip(centre, extents, BRACKET_MIDDLE, strict=True)]
        whole = _with(whole, BRepPrimAPI_MakeBox(_point(*corner), *(_MM * extent for extent in extents)).Shape())
    (x, y, z), radius, height = BRACKET_PIN
    foot = _point(x - BRACKET_MIDDLE[0], y - height / 2 - BRACKET_MIDDLE[1], z - BRACKET_MIDDLE[2])
    pin = BRepPrimAPI_MakeCylinder(gp_Ax2(foot, gp_Dir(0, 1, 0)), _MM * radius, _MM * height).Shape()
    writer = STEPControl_Writer()
    writer.Transfer(_with(whole, pin), STEPControl_AsIs)
    if writer.Write(str(path)) != IFSelect_RetDone:
        raise OSError(f"{path} cannot be written")


def _point(x_m: float, y_m: float, z_m: float) -> gp_Pnt:
    return gp_Pnt(_MM * x_m, _MM * y_m, _MM * z_m)


def _with(whole: TopoDS_Shape | None, part: TopoDS_Shape) -> TopoDS_Shape:
    return part if whole is None else BRepAlgoAPI_Fuse(whole, part).Shape()
