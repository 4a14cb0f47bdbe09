"""The names and numbers of objects in BOP's data sets."""

from collections.abc import Mapping

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
