"""The names and numbers of objects in BOP's data sets."""

from collections.abc import Mapping, Sequence

from curio_serve.errors import UsageError

LINEMOD_IDS: Mapping[str, int] = {
    "ape": 1,
    "benchvise": 2,
    "bowl": 3,
    "cam": 4,
    "can": 5,
    "cat": 6,
    "cup": 7,
    "driller": 8,
    "duck": 9,
    "eggbox": 10,
    "glue": 11,
    "holepuncher": 12,
    "iron": 13,
    "lamp": 14,
    "phone": 15,
}
"""All 15 objects of LineMOD by the numbers that BOP's LM and LM-O give them."""


def bop_object_ids(objects: Sequence[str], given: int | None) -> dict[str, int]:
    """BOP's number of each object of a model.

    Args:
        objects: Names in the model's spec.
        given: What ``--obj-id`` says; None: look the names up among LineMOD's classes.

    Raises:
        UsageError: A number is missing, or one was given for several objects.
    """
    if given is not None:
        if len(objects) != 1:
            raise UsageError(
                f"--obj-id {given} names one object, the model finds {len(objects)}: {', '.join(objects)}; "
                "choose one of them with --objects"
            )
        return {objects[0]: given}
    unknown = [name for name in objects if name not in LINEMOD_IDS]
    if unknown:
        raise UsageError(
            f"--format bop needs the object id of {', '.join(unknown)}: expected a LineMOD class "
            f"({', '.join(LINEMOD_IDS)}) or --obj-id NUMBER{' with --objects NAME' * (len(objects) > 1)}"
        )
    return {name: LINEMOD_IDS[name] for name in objects}
