"""Reads an image several times through slightly different cameras, and answers the pose on which most reads agree.

As many runs of the network as reads. The mean of reads that agree is nearer to the truth than any of them, because
each is misled by other pixels; and how many agree says more about a pose than the network's confidence does.
"""

from collections.abc import Callable

import numpy as np
from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_serve.consensus.poses import angles_deg, mean_rotation
from curio_serve.errors import ArgumentError
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS, VirtualCamera
from curio_serve.models.model import Outputs
from curio_serve.models.object_frames import (
    as_compared,
    center_of,
    middle_from_origin,
    origin_from_middle,
    symmetry_rotations,
)

Array = np.ndarray
MAX_READS = len(VIRTUAL_CAMERAS)
_SAME_ROTATION_DEG = 25.0
_SAME_PLACE = 0.5  # diameters
AGREEMENT_POWER = 0.65
"""Power of the share of the total confidence that the reads which agree have.

That share is lower than the probability that the mean of those is right, because a read that disagrees may be wrong
alone. Measured on renderings: 0.75 for two reads, 0.7 for three and five, 0.6 for seven and nine
(``benchmarks/shipped_models/reads.py``)."""


class RepeatedReader:
    """Runs a network once for each virtual camera; safe to share between threads as the network is."""

    def __init__(self, spec: ModelSpec, run: Callable[[Array], Outputs], num_reads: int) -> None:
        """Choose the virtual cameras.

        Args:
            spec: Of the model: K*, and one slot an object.
            run: Outputs by name, [batch, ...], for uint8 RGB images [batch, height, width, 3].
            num_reads: 2 to :data:`MAX_READS`.

        Raises:
            ArgumentError: The number is out of range, or the model is of a flat world, without rotations, or with
                several slots an object, whose reads cannot be told apart.
        """
        if not 2 <= num_reads <= MAX_READS:
            raise ArgumentError(f"reads is {num_reads}; expected 1 to {MAX_READS}")
        has_rotation = any(field.name in ("rotation", "rotation_6d") for field in spec.fields)
        if not spec.camera.camera_matrix or not has_rotation or any(len(kind.slots) != 1 for kind in spec.objects):
            raise ArgumentError(
                f"reads is {num_reads}, but model {spec.name} can read an image only once: several reads need a camera "
                "matrix, rotations, and one slot for each object"
            )
        self._run, self._cameras = run, VIRTUAL_CAMERAS[:num_reads]
        self._matrix = np.reshape(list(spec.camera.camera_matrix), (3, 3))
        self._kinds = sorted(spec.objects, key=lambda kind: kind.slots[0])
        self._symmetries = [symmetry_rotations(kind) for kind in self._kinds]
        self._centers_m = [center_of(kind) for kind in self._kinds]

    def __call__(self, images: Array, before_run: Callable[[], None] = lambda: None) -> Outputs:
        """Outputs of the network's names, float32 [batch, ...].

        Args:
            images: uint8 RGB [batch, height, width, 3].
            before_run: Called before each run of the network; what it raises ends the reading.
        """
        reads = []
        for camera in self._cameras:
            before_run()
            seen = np.stack([camera.image(pixels, self._matrix) for pixels in images])
            reads.append({name: np.array(values, float) for name, values in self._run(seen).items()})
            self._bring_back(reads[-1], camera)
        rows = [[{name: values[row] for name, values in read.items()} for read in reads] for row in range(len(images))]
        agreed = [self._agreed(of_image) for of_image in rows]
        return {name: np.stack([one[name] for one in agreed]).astype(np.float32) for name in agreed[0]}

    def _agreed(self, reads: list[dict[str, Array]]) -> dict[str, Array]:
        """The outputs of one image."""
        confidence = np.stack([read.get("confidence", np.ones(len(self._symmetries))) for read in reads])
        rotation, position = (np.stack([read[name] for read in reads]) for name in ("rotation", "translation_m"))
        found = {name: np.mean([read[name] for read in reads], axis=0) for name in reads[0]}
        for slot, (kind, symmetries) in enumerate(zip(self._kinds, self._symmetries, strict=True)):
            center_m = self._centers_m[slot]
            middle = middle_from_origin(position[:, slot], rotation[:, slot], center_m)
            compared = as_compared(rotation[:, slot], kind)
            angle, turned = angles_deg(compared[:, None], compared, symmetries)
            apart = np.linalg.norm(middle[:, None] - middle, axis=-1) / kind.diameter_m
            agree = (angle < _SAME_ROTATION_DEG) & (apart < _SAME_PLACE) | np.eye(len(reads), dtype=bool)
            best = int((confidence[:, slot] @ agree).argmax())
            members = np.flatnonzero(agree[:, best])
            alike = compared[members] @ symmetries[turned[members, best]]
            mean = found["rotation"][slot] = mean_rotation(alike)
            found["translation_m"][slot] = origin_from_middle(middle[members].mean(axis=0), mean, center_m)
            if "confidence" in found:
                found["confidence"][slot] = (confidence[members, slot].sum() / len(reads)) ** AGREEMENT_POWER
            if "color" in found:
                found["color"][slot] = np.mean([reads[member]["color"][slot] for member in members], axis=0)
        if "rotation_6d" in found:
            found["rotation_6d"] = np.concatenate([found["rotation"][..., 0], found["rotation"][..., 1]], axis=-1)
        return found

    def _bring_back(self, read: dict[str, Array], camera: VirtualCamera) -> None:
        """Put the poses and the light that a virtual camera sees into the real one's frame.

        A camera that zooms sees an object at another distance: the network reads where its middle is.
        """
        for rotations, positions in zip(read["rotation"], read["translation_m"], strict=True):
            for slot, center_m in enumerate(self._centers_m):
                seen_m = middle_from_origin(positions[slot], rotations[slot], center_m)
                rotations[slot], middle_m = camera.back(rotations[slot], seen_m)
                positions[slot] = origin_from_middle(middle_m, rotations[slot], center_m)
        if "light" in read:
            read["light"] = read["light"] @ camera.virtual_from_cam
