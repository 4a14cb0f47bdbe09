"""Scores of a detector for several objects on renderings that show some of them."""

from curio_train.errors import UsageError
from curio_train.evaluation.scores import add_errors, mean_of_objects, pose_scores
from curio_train.metrics.calibration import auroc, calibration_error
from curio_train.metrics.poses import ADD_THRESHOLD
from curio_train.scene_code import CONFIDENCE, SceneCode, index, poses, presence_of
from curio_train.worlds.several_objects.world import SeveralObjectsWorld

_MOST_POINTS = 2_000  # vertices that ADD is measured at, about


def several_objects_scores(world: SeveralObjectsWorld, predicted: SceneCode, true: SceneCode) -> dict[str, float]:
    """Means of the objects' pose scores where they are shown, and what all confidences say together.

    ``confidence_ece`` takes a confidence as the probability that ADD(-S) is below a tenth of the diameter, and
    ``present_auroc`` takes the presence, or the confidence where there is none, as a sign that an object is shown.

    Raises:
        UsageError: No rendering shows any object.
    """
    each, confidences, correct, present = [], [], [], []
    presence = presence_of(predicted)
    there = true[CONFIDENCE][..., 0] > 0
    for slot, member in enumerate(world.members):
        shown = there[:, slot]
        if not shown.any():
            continue
        points = member.mesh.thinned_m(_MOST_POINTS)
        found, wanted = (poses(index(code, shown), slot) for code in (predicted, true))
        each.append(pose_scores(found, wanted, points, member.kind.info))
        errors = add_errors(found, wanted, points, member.kind.info)
        confidences += predicted[CONFIDENCE][shown, slot, 0].tolist()
        present += presence[shown, slot].tolist()
        correct += [error < ADD_THRESHOLD for error in errors]
    if not each:
        raise UsageError(f"--num-images {len(there)}: none of them shows an object; expected more")
    scores = mean_of_objects(each)
    scores["confidence_ece"] = calibration_error(confidences, correct)
    if not there.all():
        scores["present_auroc"] = auroc(present, presence[~there].tolist())
    return scores
