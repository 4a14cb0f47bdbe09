"""Look at a machine, a mesh, a camera file and photographs before an hour is spent on them."""

import os
import platform
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.data.meshes import Unit, load_mesh
from curio_train.data.photographs import Photographs, read_photograph
from curio_train.data.shapes import box
from curio_train.errors import CurioError, DataError, RendererError
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.variant import check_llvm, optix_available

State = Literal["good", "warning", "bad"]
_ENOUGH_MEMORY_GIB = 3.0  # a run of the paper's networks takes about 1.5
_ENOUGH_DISK_GIB = 2.0  # image sets, a run's checkpoints, exported models
_RENDERING_LIMIT_S = 120
_SIDE_PX = 32


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes:
        subject: What was looked at.
        state: good; warning: works, but worse than it could; bad: will not work.
        text: What was found, and where it isn't good what to do.
    """

    subject: str
    state: State
    text: str


def examine(
    mesh: Path | None, mesh_unit: Unit | None, camera: Path | None, photos: Path | None, cache: Path
) -> Iterator[Finding]:
    """Everything that was asked for, the machine first.

    Args:
        mesh: A mesh file.
        mesh_unit: Of its coordinates; the file's own unless given.
        camera: Camera JSON, or BOP's ``camera.json``.
        photos: A folder of photographs, taken with that camera where one is given.
        cache: Where image sets will be kept.
    """
    yield from examine_machine(cache)
    if mesh is not None:
        yield examine_mesh(mesh, mesh_unit)
    intrinsics = None
    if camera is not None:
        intrinsics, finding = examine_camera(camera)
        yield finding
    if photos is not None:
        yield examine_photos(photos, intrinsics)


def examine_machine(cache: Path) -> Iterator[Finding]:
    """Processor, memory, disk, CUDA, libLLVM, and whether a picture comes out."""
    yield _platform()
    yield _memory()
    for folder in dict.fromkeys((Path.cwd(), _existing(cache.expanduser()))):
        yield _disk(folder)
    yield _cuda()
    llvm = _llvm()
    yield llvm
    if llvm.state == "good":
        yield _rendering()


def _platform() -> Finding:
    found = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    cores = f"{len(os.sched_getaffinity(0))} cores for this process, torch {torch.__version__}"
    supported = (platform.system(), platform.machine()) == ("Linux", "x86_64")
    remedy = "" if supported else "; supported is Linux on x86-64, elsewhere nothing was tried"
    return Finding("platform", "good" if supported else "warning", f"{found}, {cores}{remedy}")


def _memory() -> Finding:
    fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    total, available = (int(fields[name].split()[0]) / 2**20 for name in ("MemTotal", "MemAvailable"))
    text = f"{available:.1f} of {total:.1f} GiB are free"
    if available < _ENOUGH_MEMORY_GIB:
        return Finding("memory", "warning", f"{text}, training wants {_ENOUGH_MEMORY_GIB:g}: lower --micro-batch-size")
    return Finding("memory", "good", text)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 2**30
    subject, text = f"disk at {folder}", f"{free:.1f} GiB are free"
    if not os.access(folder, os.W_OK):
        return Finding(subject, "bad", "cannot be written: choose other folders with --out and --cache")
    if free < _ENOUGH_DISK_GIB:
        return Finding(subject, "warning", f"{text}, a run wants {_ENOUGH_DISK_GIB:g}: make room, or --out and --cache")
    return Finding(subject, "good", text)


def _existing(path: Path) -> Path:
    """The folder, or the closest above it that is there."""
    return next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())


def _cuda() -> Finding:
    driver = shutil.which("nvidia-smi") is not None
    if torch.cuda.is_available():
        names = ", ".join(torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count()))
        if optix_available():
            return Finding("CUDA", "good", f"{names}; networks and renderer can run there")
        return Finding("CUDA", "warning", f"{names}; the driver brings no OptiX (libnvoptix.so.1): the CPU will render")
    if driver:
        return Finding(
            "CUDA", "warning", f"a driver is here, but torch {torch.__version__} cannot use it: install a CUDA build"
        )
    return Finding("CUDA", "good", "no GPU: everything runs on the CPU, as the laptop preset expects")


def _llvm() -> Finding:
    try:
        return Finding("libLLVM", "good", check_llvm())
    except CurioError as exc:
        return Finding("libLLVM", "bad", str(exc))


def _rendering() -> Finding:
    """In a process of its own: a libLLVM that Dr.Jit cannot use takes the process with it."""
    code = "from curio_train.doctor import render_a_box; print(render_a_box())"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=_RENDERING_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return Finding("rendering", "bad", f"a box of {_SIDE_PX} pixels took longer than {_RENDERING_LIMIT_S} s")
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["without a word"])[-1]
        remedy = "try another libLLVM (DRJIT_LIBLLVM_PATH), version 17 or newer"
        return Finding("rendering", "bad", f"a test picture failed with status {done.returncode}: {said}; {remedy}")
    return Finding("rendering", "good", f"a box covers {float(done.stdout):.0%} of a test picture, as it should")


def render_a_box() -> float:
    """Share of the pixels that a white box covers whose face fills a quarter of the picture.

    Raises:
        RendererError: The picture shows something else.
    """
    renderer = Renderer([box((1.0, 1.0, 0.01))], [0], _SIDE_PX, _SIDE_PX, ambient=1.0)
    focal, centre = float(_SIDE_PX), (_SIDE_PX - 1) / 2
    picture = renderer(
        torch.eye(3)[None, None],
        torch.tensor([[[0.0, 0.0, 2.005]]]),
        camera_matrix=np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1]]),
        backgrounds=torch.zeros(1, 3, _SIDE_PX, _SIDE_PX),
        light=torch.zeros(1, 3),
    )
    share = float((picture.mean(dim=1) > 0.25).float().mean())
    if not 0.24 <= share <= 0.26:
        raise RendererError(f"the test picture's box covers {share:.1%} of it, expected 25 %")
    return share


def examine_mesh(path: Path, unit: Unit | None) -> Finding:
    """Whether a mesh can be trained on, and how large it was taken to be."""
    try:
        mesh = load_mesh(path, unit)
    except CurioError as exc:
        return Finding("mesh", "bad", str(exc))
    extent = " x ".join(f"{size * 1000:.4g}" for size in np.ptp(mesh.vertices_m, axis=0))
    looks = "a texture" if mesh.texture is not None else "vertex colours" if mesh.vertex_colors_srgb is not None else ""
    text = (
        f"{path}: {len(mesh.faces):,} faces, {extent} mm, diameter {mesh.diameter_m * 1000:.4g} mm; if that is not its "
        f"true size, set --mesh-unit. It has {looks or 'no colours'}"
    )
    if not looks:
        return Finding("mesh", "warning", f"{text}: it will be rendered in one colour")
    return Finding("mesh", "good", text)


def examine_camera(path: Path) -> tuple[Intrinsics | None, Finding]:
    """Whether a camera file describes a camera; its field of view shows most mistakes."""
    try:
        found = load_intrinsics(path)
    except CurioError as exc:
        return None, Finding("camera", "bad", str(exc))
    sizes = np.array([found.width, found.height])
    across, down = np.degrees(2 * np.arctan(sizes / 2 / np.diag(found.matrix)[:2]))
    bent = "with distortion" if found.distortion else "without distortion"
    text = f"{path}: {found.width}x{found.height} pixels, sees {across:.0f} by {down:.0f} degrees, {bent}"
    return found, Finding("camera", "good", text)


def examine_photos(folder: Path, camera: Intrinsics | None) -> Finding:
    """Whether all photographs can be read, and have the camera's size."""
    try:
        paths = Photographs(folder).paths
    except CurioError as exc:
        return Finding("photographs", "bad", str(exc))
    sizes: Counter[tuple[int, int]] = Counter()
    broken = []
    for path in paths:
        try:
            height, width = read_photograph(path).shape[:2]
        except DataError as exc:
            broken.append(str(exc))
        else:
            sizes[width, height] += 1
    found = ", ".join(f"{count} of {width}x{height}" for (width, height), count in sizes.most_common(3))
    if broken:
        return Finding("photographs", "bad", f"{len(broken)} of {len(paths)} cannot be read, the first: {broken[0]}")
    if camera is not None and set(sizes) != {(camera.width, camera.height)}:
        expected = f"the camera file is for {camera.width}x{camera.height}"
        return Finding("photographs", "bad", f"{folder}: {found}; {expected}: they are not of this camera, or resized")
    return Finding("photographs", "good", f"{folder}: {found}")
