"""Files of one's own, looked at before an hour is spent on them: what will not work is refused, all of it at once."""

from dataclasses import replace

from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.photographs import examine_photographs
from curio_train.errors import DataError
from curio_train.worlds.options import CaptureOptions

_HARMLESS_ON_A_PLANE = ("no colour",)  # colours are part of the code
_HARMLESS = (*_HARMLESS_ON_A_PLANE, "too few")  # off the plane nothing is learned from the photographs
_BROKEN = "photographs unreadable"  # all that matters about other scenes: they may differ in size and be few


def refuse_unfit(options: CaptureOptions) -> list[str]:
    """Compare the meshes, the camera, the photographs and the plate; read every other background.

    Returns:
        What is doubtful about them, a line each.

    Raises:
        DataError: Something is certain not to work; says everything that is.
    """
    first, *others = options.mesh
    subjects = [Subjects(first, options.mesh_unit, options.camera, options.photos, options.background)]
    subjects += [Subjects(mesh, options.mesh_unit) for mesh in others]
    found = [finding for subject in subjects for finding in examine_files(subject)]
    harmless = _HARMLESS if options.plane is None else _HARMLESS_ON_A_PLANE
    found = [finding for finding in found if finding.state != "good" and finding.fault not in harmless]
    if options.backgrounds is not None:
        _, scenes = examine_photographs(options.backgrounds, None)
        found += [replace(finding, subject="backgrounds") for finding in scenes if finding.fault == _BROKEN]
    unfit = [finding for finding in found if finding.state == "bad" and finding.sure == "certain"]
    if unfit:
        raise DataError("\n".join(f"{finding.subject}: {finding}" for finding in unfit))
    return [f"{finding.subject}: {finding}" for finding in found]
