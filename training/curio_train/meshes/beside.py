"""Files beside a mesh that it names: materials, textures and buffers."""

import io
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import trimesh
from curio_serve.files import read_file
from PIL import Image

from curio_train.errors import MeshError

# Such as "-s 1 1 1 " and "-clamp on " before the name of a texture.
_MTL_OPTIONS = re.compile(r"(?:-[a-z]+\s+(?:(?:on|off|[rgbmlz]|[-+]?[\d.]+(?:e[-+]?\d+)?)\s+)+)+", re.IGNORECASE)


class Beside(trimesh.resolvers.FilePathResolver):
    """Reads what a mesh names, and remembers what it could not read, as trimesh goes on without it.

    Args:
        mesh: The file of the mesh.
        max_bytes: Size of the largest file accepted.
    """

    def __init__(self, mesh: Path, max_bytes: int) -> None:
        super().__init__(str(mesh))
        self._mesh, self._max_bytes = mesh, max_bytes
        self._faults: dict[str, str] = {}
        self._has_read = False

    def get(self, name: str) -> bytes:
        """The content of one; only of regular files.

        Raises:
            OSError: There is none, or it is too large.
        """
        try:
            content = self._content(name)
        except OSError as exc:
            # An OBJ file names its materials first, and is a mesh without them.
            if self._mesh.suffix.lower() != ".obj" or self._has_read:
                self._faults[name] = exc.strerror or "there is no such file"
            raise
        self._has_read = True
        if Path(name.lower()).suffix in Image.registered_extensions():
            try:
                Image.open(io.BytesIO(content)).close()
            except (OSError, ValueError, Image.DecompressionBombError):
                self._faults[name] = "it is no image, or a huge one"
        return content

    def refuse_missing(self) -> None:
        """Refuse a mesh that lacks one of its textures.

        Raises:
            MeshError: One could not be read.
        """
        for name, fault in self._faults.items():
            remedy = "take its line out of the MTL file" if self._mesh.suffix.lower() == ".obj" else "export it without"
            raise MeshError(
                f"{self._mesh}: its texture {name} cannot be read ({fault}); expected it beside the mesh; put it "
                f"there, or {remedy}"
            )

    def _content(self, name: str) -> bytes:
        for find in (self.absolute, self._in_any_case):
            for spelling in _spellings(name):
                with suppress(FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: it would lie elsewhere
                    return read_file(find(spelling), self._max_bytes)
        raise FileNotFoundError(f"there is no file {name}")

    def _in_any_case(self, name: str) -> Path:
        place = Path(self.parent)
        for part in PurePosixPath(name).parts:
            alike = [entry for entry in place.iterdir() if entry.name.casefold() == part.casefold()]
            if not alike:
                raise FileNotFoundError(f"there is no file {name}")
            place = min(alike)
        return self.absolute(str(place.relative_to(self.parent)))


def _spellings(name: str) -> Iterator[str]:
    """What may be meant, likeliest first: from Windows, another machine, or quoted as glTF has it."""
    written = name.strip()
    for path in (written, _MTL_OPTIONS.sub("", written).strip('"').replace("\\", "/"), unquote(written)):
        yield from filter(None, (path, path.lstrip("/"), PurePosixPath(path).name))
