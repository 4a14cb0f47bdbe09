"""Camera files as ``--camera`` reads them."""

import json
import os
from pathlib import Path

from curio_train.camera import Intrinsics
from curio_train.errors import CameraError


def save_intrinsics(path: Path, camera: Intrinsics) -> None:
    """Write camera JSON, whole or not at all.

    Raises:
        CameraError: The file cannot be written.
    """
    content = {
        "camera_matrix": camera.matrix.tolist(),
        "width": camera.width,
        "height": camera.height,
        "distortion": list(camera.distortion or (0.0,) * 5),
    }
    draft = path.with_name(f"{path.name}.part")
    try:
        draft.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        os.replace(draft, path)
    except OSError as exc:
        raise CameraError(f"{path}: cannot be written ({exc.strerror}); name another file: --camera-out") from exc
