"""All exceptions that training raises on purpose.

    CurioError
    ├── UsageError            the call is wrong: exit status 2
    │   └── ResumeMismatch    a run continued with another configuration
    └── WorkError             the work failed: exit status 1
        ├── DataError         a data folder, an image, an annotation
        ├── MeshError         a mesh file
        ├── CameraError       intrinsics
        ├── RendererError     Mitsuba, Dr.Jit, libLLVM, OptiX
        ├── CheckpointError   a run folder or what is in it
        ├── TrainingError     the optimisation itself
        ├── ExportError       ONNX, parity, the model folder
        └── ReportError       report.html of a run

A text says what was found, what was expected, where (file, field, flag) and what to do.
"""

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str:
    """A question that proposes the name most like a mistyped one; empty where none is like it."""
    found = difflib.get_close_matches(word, list(known), 1)
    return f" (did you mean {found[0]}?)" if found else ""


class CurioError(Exception):
    """Base of all errors of this package."""

    exit_status = 1


class UsageError(CurioError):
    """The command or call cannot be carried out as written."""

    exit_status = 2


class ResumeMismatch(UsageError):
    """A run is continued with a configuration that differs from the one it was started with."""


class WorkError(CurioError):
    """The call was right, the work failed."""


class DataError(WorkError):
    """A data folder, image or annotation is missing or malformed."""


class MeshError(WorkError):
    """A mesh file is missing, empty, malformed or of an impossible size."""


class CameraError(WorkError):
    """Camera intrinsics are missing, singular or do not fit the image."""


class RendererError(WorkError):
    """The renderer cannot start or was given what it cannot render."""


class CheckpointError(WorkError):
    """A run folder or checkpoint cannot be read or written."""


class TrainingError(WorkError):
    """A loss or a gradient is not finite."""


class ExportError(WorkError):
    """The model could not be exported, or an exported model cannot be used."""


class ReportError(WorkError):
    """A run's report could not be drawn or written; the run itself is whole."""
