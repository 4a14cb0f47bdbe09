"""CAD files: STEP and IGES by a CAD kernel, read as meshes by the doctor, the capture and the renderer."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_train.commands import doctor as doctor_command
from curio_train.commands import train as train_command
from curio_train.commands.prepare import prepared, with_kept_meshes
from curio_train.config import RunConfig
from curio_train.doctor.examine import Subjects, examine_files
from curio_train.drawing.album import MeshFiles, scene_context
from curio_train.errors import MeshError, UsageError
from curio_train.learning.runs.configuration import load_config
from curio_train.meshes import cad
from curio_train.meshes.meshes import load_mesh, to_ply
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeFace
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder, BRepPrimAPI_MakeSphere
from OCP.gp import gp_Ax2, gp_Dir, gp_Pln, gp_Pnt, gp_Trsf, gp_Vec
from OCP.IGESControl import IGESControl_Writer
from OCP.Interface import Interface_Static
from OCP.Quantity import Quantity_Color, Quantity_TOC_sRGB
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.TCollection import TCollection_ExtendedString
from OCP.TDataStd import TDataStd_Name
from OCP.TDocStd import TDocStd_Document
from OCP.TopLoc import TopLoc_Location
from OCP.XCAFApp import XCAFApp_Application
from OCP.XCAFDoc import XCAFDoc_ColorType, XCAFDoc_DocumentTool

Shape = Any


def box(corner_mm: Sequence[float], size_mm: Sequence[float]) -> Shape:
    return BRepPrimAPI_MakeBox(gp_Pnt(*corner_mm), *size_mm).Shape()


def upright_cylinder(foot_mm: Sequence[float], radius_mm: float, height_mm: float) -> Shape:
    return BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(*foot_mm), gp_Dir(0, 0, 1)), radius_mm, height_mm).Shape()


def ball(radius_mm: float) -> Shape:
    return BRepPrimAPI_MakeSphere(radius_mm).Shape()


def bracket() -> Shape:
    """80 x 40 x 50 mm round its own origin: a base with a wall and a hole through the base."""
    base, wall = box((-40, -20, -25), (80, 40, 10)), box((-40, -20, -25), (10, 40, 50))
    return BRepAlgoAPI_Cut(BRepAlgoAPI_Fuse(base, wall).Shape(), upright_cylinder((10, 0, -30), 8, 30)).Shape()


def sheet() -> Shape:
    return BRepBuilderAPI_MakeFace(gp_Pln(), -50, 50, -30, 30).Face()


def line() -> Shape:
    return BRepBuilderAPI_MakeEdge(gp_Pnt(0, 0, 0), gp_Pnt(10, 0, 0)).Edge()


def write_step(path: Path, *shapes: Shape, unit: str = "MM") -> Path:
    writer = STEPControl_Writer()
    Interface_Static.SetCVal_s("write.step.unit", unit)
    for shape in shapes:
        writer.Transfer(shape, STEPControl_AsIs)
    writer.Write(str(path))
    return path


def write_iges(path: Path, shape: Shape, unit: str = "MM") -> Path:
    writer = IGESControl_Writer(unit, 0)
    writer.AddShape(shape)
    writer.ComputeModel()
    writer.Write(str(path))
    return path


class Assembly:
    """Parts with names, colours and places."""

    def __init__(self) -> None:
        self._document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
        XCAFApp_Application.GetApplication_s().InitDocument(self._document)
        self._shapes = XCAFDoc_DocumentTool.ShapeTool_s(self._document.Main())
        self._colors = XCAFDoc_DocumentTool.ColorTool_s(self._document.Main())
        self._whole = self._shapes.NewShape()

    def add(
        self, name: str, shape: Shape, places_mm: Sequence[Sequence[float]], color: Sequence[float] | None = None
    ) -> None:
        label = self._shapes.AddShape(shape, False)
        TDataStd_Name.Set_s(label, TCollection_ExtendedString(name))
        if color is not None:
            painted = Quantity_Color(*color, Quantity_TOC_sRGB)
            self._colors.SetColor(label, painted, XCAFDoc_ColorType.XCAFDoc_ColorSurf)
        for place in places_mm:
            transform = gp_Trsf()
            transform.SetTranslation(gp_Vec(*place))
            self._shapes.AddComponent(self._whole, label, TopLoc_Location(transform))

    def write(self, path: Path) -> Path:
        self._shapes.UpdateAssemblies()
        writer = STEPCAFControl_Writer()
        Interface_Static.SetCVal_s("write.step.unit", "MM")
        writer.Transfer(self._document, STEPControl_AsIs)
        writer.Write(str(path))
        return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """bracket.step of 80 x 40 x 50 mm, and hinge.step: a red plate and two dark green bolts, which lie apart."""
    root = tmp_path_factory.mktemp("cad")
    write_step(root / "bracket.step", bracket())
    hinge = Assembly()
    hinge.add("plate", box((0, 0, 0), (80, 40, 10)), [(0, 0, 0)], color=(1, 0, 0))
    hinge.add("bolt", upright_cylinder((0, 0, -5), 8, 30), [(20, 20, 0), (60, 20, 0)], color=(0, 0.5, 0))
    hinge.write(root / "hinge.step")
    return root


@pytest.mark.parametrize(
    ("name", "unit"), [("a.step", "MM"), ("b.STP", "INCH"), ("c.step", "M"), ("d.iges", "MM"), ("e.igs", "INCH")]
)
def test_units_are_the_files_own(tmp_path: Path, name: str, unit: str) -> None:
    write = write_iges if ".ig" in name else write_step
    mesh = load_mesh(write(tmp_path / name, bracket(), unit=unit))
    assert np.ptp(mesh.vertices_m, axis=0) == pytest.approx([0.08, 0.04, 0.05], rel=1e-5)
    assert mesh.diameter_m == pytest.approx(np.linalg.norm([0.08, 0.04, 0.05]), rel=1e-5)
    assert mesh.vertex_colors_srgb is None


def test_the_tolerance_is_a_thousandth_of_the_diameter(tmp_path: Path) -> None:
    mesh = load_mesh(write_step(tmp_path / "ball.step", ball(50)))
    middles_m = mesh.vertices_m[mesh.faces].mean(axis=1)
    assert np.linalg.norm(mesh.vertices_m, axis=1) == pytest.approx(0.05, rel=1e-6)
    depth_m = 0.05 - np.linalg.norm(middles_m, axis=1)
    assert 0.1 * cad.TOLERANCE * 0.1 < depth_m.max() < cad.TOLERANCE * 0.1
    edges = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "closed where the kernel's patches meet"


def test_bodies_are_merged_as_placed_with_their_colours(folder: Path) -> None:
    mesh = load_mesh(folder / "hinge.step")
    assert sorted(mesh.bodies) == ["bolt", "bolt", "plate"]
    assert np.ptp(mesh.vertices_m, axis=0) == pytest.approx([0.08, 0.04, 0.03], rel=1e-5)
    assert mesh.vertex_colors_srgb is not None
    heads = mesh.vertex_colors_srgb[mesh.vertices_m[:, 2] > 0.02]
    assert heads == pytest.approx(np.tile([0, 0.5, 0], (len(heads), 1)), abs=0.01)


def test_one_body_by_its_name_in_its_own_frame(folder: Path) -> None:
    mesh = load_mesh(folder / "hinge.step", body="bolt")
    assert mesh.bodies == ("bolt",)
    assert mesh.vertices_m.min(axis=0) == pytest.approx([-0.008, -0.008, -0.005], abs=1e-4)
    assert mesh.vertices_m.max(axis=0) == pytest.approx([0.008, 0.008, 0.025], abs=1e-4)
    with pytest.raises(MeshError, match=r"no body 'nut', expected one of: plate, bolt \(2\)"):
        load_mesh(folder / "hinge.step", body="nut")


def test_bodies_of_one_name_that_differ_are_not_taken_for_one(tmp_path: Path) -> None:
    two = Assembly()
    two.add("Solid", box((0, 0, 0), (50, 10, 5)), [(0, 0, 0)], color=(1, 0, 0))
    two.add("Solid", box((0, 0, 0), (20, 20, 20)), [(90, 0, 0)], color=(1, 0, 0))
    two.write(tmp_path / "two.step")
    with pytest.raises(MeshError, match=r"bodies of 20 x 20 x 20 and 50 x 10 x 5 mm are called 'Solid'; give each"):
        load_mesh(tmp_path / "two.step", body="Solid")
    assert len(load_mesh(tmp_path / "two.step").bodies) == 2


def test_flags_that_a_cad_file_contradicts(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--mesh-unit mm: .* names its own unit"):
        load_mesh(folder / "bracket.step", "mm")
    (tmp_path / "part.ply").write_bytes(to_ply(load_mesh(folder / "bracket.step")))
    with pytest.raises(UsageError, match=r"--body bolt: .* is no CAD file"):
        load_mesh(tmp_path / "part.ply", body="bolt")
    with pytest.raises(UsageError, match="expected one --mesh"):
        scene_context(MeshFiles((f"a={folder / 'hinge.step'}", f"b={folder / 'bracket.step'}"), body="bolt"))


def test_a_written_mesh_is_the_same_mesh(folder: Path, tmp_path: Path) -> None:
    mesh = load_mesh(folder / "hinge.step")
    (tmp_path / "hinge.ply").write_bytes(to_ply(mesh))
    again = load_mesh(tmp_path / "hinge.ply")
    assert (again.vertices_m == mesh.vertices_m).all()
    assert (again.faces == mesh.faces).all()
    assert mesh.vertex_colors_srgb is not None
    assert again.vertex_colors_srgb is not None
    assert (again.vertex_colors_srgb == mesh.vertex_colors_srgb).all()
    assert again.sha256 == mesh.sha256


def header_alone(path: Path) -> bytes:
    head, _, _ = write_step(path, bracket()).read_bytes().partition(b"DATA;")
    return head + b"DATA;\nENDSEC;\nEND-ISO-10303-21;\n"


@pytest.mark.parametrize(
    ("name", "make", "said"),
    [
        ("header.step", lambda path: path.write_bytes(header_alone(path)), "found no body"),
        ("drawing.step", lambda path: write_step(path, line()), "curves and no surface"),
        ("sheet.step", lambda path: write_step(path, sheet()), "a sheet without thickness"),
        ("sheet.iges", lambda path: write_iges(path, sheet()), "a sheet without thickness"),
        ("half.step", lambda path: path.write_bytes(write_step(path, bracket()).read_bytes()[:20_000]), "complete"),
        ("half.iges", lambda path: path.write_bytes(write_iges(path, bracket()).read_bytes()[:20_000]), "complete"),
        ("words.step", lambda path: path.write_text("hello END-ISO-10303-21;"), "found no body"),
        ("empty.stp", lambda path: path.touch(), "0 bytes"),
        ("none.step", lambda path: None, "cannot be read"),
        ("pipe.step", lambda path: os.mkfifo(path), "not a regular file"),
        ("dust.step", lambda path: write_step(path, ball(0.01)), "export it again in its true unit"),
    ],
)
def test_refuses(tmp_path: Path, name: str, make: Any, said: str) -> None:
    make(tmp_path / name)
    with pytest.raises(MeshError, match=said):
        load_mesh(tmp_path / name)


def test_a_file_that_is_too_large(tmp_path: Path) -> None:
    with (tmp_path / "huge.step").open("wb") as sparse:
        sparse.truncate(60 << 30)
    with pytest.raises(MeshError, match="at most"):
        load_mesh(tmp_path / "huge.step")


def test_a_million_faces(tmp_path: Path) -> None:
    many = Assembly()
    places = [(3 * (i % 20), 3 * (i // 20 % 20), 3 * (i // 400)) for i in range(1600)]
    many.add("ball", ball(1), places)
    mesh = load_mesh(many.write(tmp_path / "many.step"))
    assert len(mesh.faces) > 1_000_000
    assert len(mesh.bodies) == 1600


def test_without_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cad.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'curio-pose\[cad\]'"):
        load_mesh(folder / "bracket.step")


def test_the_doctor_names_bodies(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = {finding.subject: finding for finding in examine_files(Subjects(mesh=folder / "hinge.step"))}
    assert found["mesh bodies"].text == "3 bodies were merged into one object: plate, bolt (2)"
    assert found["mesh colours"].state == "good"
    call = ["--mesh", str(folder / "hinge.step"), "--body", "bolt", "--symmetries", str(tmp_path / "bolt.json")]
    with pytest.raises(SystemExit):
        doctor_command.doctor([*call, "--cache", str(tmp_path)])
    assert "mesh bodies" not in capsys.readouterr().out
    (bolt,) = json.loads((tmp_path / "bolt.json").read_text()).values()
    assert bolt["diameter"] == pytest.approx(np.hypot(16, 30), rel=1e-3)
    assert bolt["symmetries_continuous"][0]["axis"] == pytest.approx([0, 0, 1], abs=0.01)


def test_the_doctor_does_not_advise_a_unit_that_is_refused(tmp_path: Path) -> None:
    write_step(tmp_path / "ball.step", ball(2000))
    (finding,) = (found for found in examine_files(Subjects(mesh=tmp_path / "ball.step")) if found.fault == "mesh unit")
    assert "diameter of 4" in finding.text
    assert finding.remedy == "If it is not the object's true size, export it again in its true unit"


WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def capture(folder: Path) -> CaptureOptions:
    """Twelve photographs of something, the empty scene, and a camera file beside the CAD files."""
    intrinsics = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": WIDTH, "height": HEIGHT}
    (folder / "camera.json").write_text(json.dumps(intrinsics))
    random = np.random.default_rng(0)
    plate = cv2.resize(random.integers(40, 220, (12, 16, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    cv2.imwrite(str(folder / "plate.png"), plate)
    (folder / "photos").mkdir()
    for number in range(12):
        photo = plate.copy()
        x, y = random.integers(20, (WIDTH - 50, HEIGHT - 50))
        photo[y : y + 30, x : x + 30] = (40, 90, 140)
        cv2.imwrite(str(folder / "photos" / f"{number:02d}.png"), photo)
    files = {"camera": folder / "camera.json", "photos": folder / "photos", "background": folder / "plate.png"}
    return CaptureOptions(mesh=(folder / "bracket.step",), **files)


def test_a_run_keeps_its_mesh(capture: CaptureOptions, tmp_path: Path) -> None:
    said: list[str] = []
    config = prepared(RunConfig(capture), tmp_path, said.append, said.append)
    kept = with_kept_meshes(config, tmp_path / "run")
    assert isinstance(kept.world, CaptureOptions)
    (path,) = kept.world.mesh
    assert path == tmp_path / "run" / "meshes" / "bracket.ply"
    assert load_mesh(path).sha256 == load_mesh(capture.mesh[0]).sha256
    (tmp_path / "run" / "config.json").touch()
    path.write_bytes(b"another run's")
    assert with_kept_meshes(config, tmp_path / "run") == config
    assert path.read_bytes() == b"another run's"


def test_a_few_steps_of_training(
    capture: CaptureOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    small_checks: None,
) -> None:
    """The run is whole, and its world is built of the mesh that it keeps; a model of such a run is made elsewhere."""
    monkeypatch.setattr("curio_train.data.backgrounds.POOL_SIZE", 10)
    run = tmp_path / "run"
    run.mkdir()
    (run / "models").write_text("in the way")
    words = ["--mesh", capture.mesh[0], "--camera", capture.camera, "--photos", capture.photos, "--background"]
    words += [capture.background, "--images", 12, "--batch-size", 4, "--micro-batch-size", 4]
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", *map(str, words), "--out", str(run), "--cache", str(tmp_path / "cache")])
    assert exit_.value.code == 1
    assert f"{run} is trained and whole, but no model could be made" in capsys.readouterr().err
    world = load_config(run).world
    assert isinstance(world, CaptureOptions)
    assert world.mesh == (run / "meshes" / "bracket.ply",)
    assert build(world).model_name == "bracket"
