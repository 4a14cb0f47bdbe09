"""One pose of a thing that stands still, settled by photographs of it together.

Readings of single photographs agree on a pose to some degrees and per cent of the distance. Here render-and-compare
moves that one pose until several photographs at once miss least. Each tells what lies across its view, so cameras
around a thing tell of all of it (as bundle adjustment does in Labbé et al. 2020, "CosyPose", section 3.3, from pixels
here instead of readings).

Half turns are not tried: a dozen photographs tell a can from one that is turned round, but take an eggbox for one that
lies upside down (docs/experiments.md).
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor

from curio_train.geometry import Pose, rotation_6d_from_matrix
from curio_train.scene_code import ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.comparison import rotation_from_vector
from curio_train.worlds.refinement import LEAST_SEEN, Refinement

_MOST_ASKED, _FEWEST_ASKED = 14, 4  # photographs


class Photographs(NamedTuple):
    """Photographs of a still scene.

    Attributes:
        frames: sRGB.
        cam_from_world: Of each, rigid, metres.
        code: What was read in them; all but the pose is taken from it.
    """

    frames: UInt8[Tensor, "num 3 height width"]
    cam_from_world: Float[Tensor, "num 4 4"]
    code: SceneCode

    def of(self, chosen: np.ndarray) -> "Photographs":
        """Those of these numbers."""
        rows = torch.from_numpy(chosen)
        return Photographs(self.frames[rows], self.cam_from_world[rows], {k: v[rows] for k, v in self.code.items()})

    def showing(self, rotation: Float[Tensor, "3 3"], position_m: Float[Tensor, " 3"]) -> dict[str, Tensor]:
        """The code with the object at this pose of the scene in each; differentiable."""
        turn, shift = self.cam_from_world[:, :3, :3], self.cam_from_world[:, :3, 3]
        pose = {
            TRANSLATION: (turn @ position_m + shift)[:, None],
            ROTATION_6D: rotation_6d_from_matrix(turn @ rotation)[:, None],
        }
        return dict(self.code) | pose

    def showing_pose(self, pose: Pose) -> dict[str, Tensor]:
        """The same of a pose in NumPy's arrays."""
        return self.showing(torch.from_numpy(pose.rotation).float(), torch.from_numpy(pose.translation_m).float())


def settled(refine: Refinement, photographs: Photographs, pose: Pose) -> Pose:
    """The pose after the move with which photographs together miss least.

    Args:
        refine: Of the object.
        photographs: All in which the pose lies within the frame; asked are some of those that show something there.
        pose: That readings agree on, in the scene's frame; it stays what it is where fewer than four show it.
    """
    asked = _asked(refine, photographs, pose)
    if len(asked.frames) < _FEWEST_ASKED:
        return pose
    rotation, position_m = (torch.from_numpy(value).float() for value in (pose.rotation, pose.translation_m))

    def showing(turn: Tensor, shift: Tensor) -> dict[str, Tensor]:
        return asked.showing(rotation_from_vector(turn) @ rotation, position_m + shift * refine.diameter_m)

    turn, shift = (move.double().numpy() for move in refine.in_common(asked.frames, showing))
    return Pose(Rotation.from_rotvec(turn).as_matrix() @ pose.rotation, pose.translation_m + shift * refine.diameter_m)


def _asked(refine: Refinement, photographs: Photographs, pose: Pose) -> Photographs:
    """Evenly over all that show something there."""
    if len(photographs.frames) == 0:
        return photographs
    explained = refine.explained(photographs.frames, photographs.showing_pose(pose)).numpy()
    shown = np.flatnonzero(explained > LEAST_SEEN)
    return photographs.of(shown[np.linspace(0, len(shown) - 1, min(_MOST_ASKED, len(shown))).round().astype(int)])
