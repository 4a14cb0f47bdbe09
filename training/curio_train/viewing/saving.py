"""Saves an edited scene as a line that ``curio-render`` and ``curio-view`` read."""

import json
from pathlib import Path

from curio_train.drawing.scenes import Scene
from curio_train.errors import DataError


def save(scene: Scene, file: Path) -> None:
    """Append a scene to a JSON Lines file, in the layout of ``curio-detect``; the folder is made where it is missing.

    Raises:
        DataError: The file cannot be written.
    """
    line = json.dumps(_record(scene))
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a", encoding="utf-8") as out:
            out.write(line + "\n")
    except OSError as exc:
        raise DataError(f"{file}: the scene code cannot be saved ({exc.strerror}); choose another --out") from exc


def _record(scene: Scene) -> dict[str, object]:
    return {
        "image": scene.name if scene.photograph is None else str(scene.photograph.absolute()),
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
            }
            for item in scene.objects
        ],
        "light": None if scene.light is None else scene.light.tolist(),
        **({} if scene.world is None else {"world": scene.world}),
    }
