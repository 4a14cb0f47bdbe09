"""Files of one's own, looked at before an hour is spent on them: what will not work is refused, all of it at once."""

from dataclasses import replace

from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.photographs import examine_photographs
from curio_train.errors import DataError
from curio_train.worlds.options import CaptureOptions

_HARMLESS = ("no colour", "too few")  # colours are part of the code; nothing is learned from the photographs
_BROKEN = "photographs unreadable"  # all that matters about other scenes: they may differ in size and be few


def refuse_unfit(options: CaptureOptions) -> list[str]:
    """Compare the mesh, the camera, the photographs and the plate; read every other background.

    Returns:
        What is doubtful about them, a line each.

    Raises:
        DataError: Something is certain not to work; says everything that is.
    """
    subjects = Subjects(options.mesh, options.mesh_unit, options.camera, options.photos, options.background)
    found = [
        finding for finding in examine_files(subjects) if finding.state != "good" and finding.fault not in _HARMLESS
    ]
    if options.backgrounds is not None:
        _, scenes = examine_photographs(options.backgrounds, None)
        found += [replace(finding, subject="backgrounds") for finding in scenes if finding.fault == _BROKEN]
    unfit = [finding for finding in found if finding.state == "bad" and finding.sure == "certain"]
    if unfit:
        raise DataError("\n".join(f"{finding.subject}: {finding}" for finding in unfit))
    return [f"{finding.subject}: {finding}" for finding in found]
