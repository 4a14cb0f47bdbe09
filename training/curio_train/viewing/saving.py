"""Saves an edited scene as a line that ``curio-render`` and ``curio-view`` read."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from curio_serve.imaging.camera import PinholeCamera

from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import DataError
from curio_train.viewing.pages import Page


def save(page: Page, file: Path) -> None:
    """Append a page's scene to a JSON Lines file, in the layout of ``curio-detect``.

    Folders are made where they are missing. Validation images of a run have no file: such an image is written beside
    the scene, named after its content.

    Raises:
        DataError: The file or the image cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps(_record(_with_file(page, file), page.context))
        with file.open("a", encoding="utf-8") as out:
            out.write(line + "\n")
    except OSError as exc:
        raise DataError(f"{file}: the scene code cannot be saved ({exc.strerror}); choose another --out") from exc


def _with_file(page: Page, file: Path) -> Scene:
    """The page's scene; if objects are drawn over its image, the photograph is a file."""
    if not page.over_image or page.scene.photograph is not None:
        return page.scene
    _, png = cv2.imencode(".png", np.ascontiguousarray(page.image[..., ::-1]))
    content = png.tobytes()
    image = file.with_name(f"{file.stem}-{hashlib.sha256(content).hexdigest()[:12]}.png")
    image.write_bytes(content)
    return replace(page.scene, photograph=image)


def _record(scene: Scene, context: SceneContext) -> dict[str, object]:
    camera = PinholeCamera(scene.camera_matrix, scene.distortion)
    return {
        "image": _image(scene),
        "width": scene.width,
        "height": scene.height,
        "camera_matrix": scene.camera_matrix.tolist(),
        **({"distortion": list(scene.distortion)} if any(scene.distortion) else {}),
        **({"exif_rotation": True} if scene.exif_rotation else {}),
        "detections": [
            {
                "object": item.kind,
                "confidence": item.confidence,
                "translation_m": item.pose.translation_m.tolist(),
                "rotation": item.pose.rotation.tolist(),
                "color": list(item.color_srgb),
                **({} if scene.world is not None else _box(item, context, camera)),
            }
            for item in scene.objects
        ],
        "light": None if scene.light is None else scene.light.tolist(),
        **({} if scene.world is None else {"world": scene.world}),
    }


def _box(item: Placed, context: SceneContext, camera: PinholeCamera) -> dict[str, object]:
    """``box_px``, by which a mesh in another unit is refused; nothing where a corner is behind the camera."""
    corners_m = item.pose.apply(context.mesh(item.kind).box_corners_m)
    return {"box_px": camera.project(corners_m).tolist()} if corners_m[:, 2].min() > 0 else {}


def _image(scene: Scene) -> str | None:
    if scene.world is not None:
        return scene.name
    return None if scene.photograph is None else str(scene.photograph.absolute())
