"""The scene code: named physical quantities, described once for heads, renderer, metrics, export and tables.

A scene code is a mapping from field name to tensor: ``[batch, num_slots, size]`` for per-object fields and
``[batch, size]`` for per-scene ones. No code slices a vector by number; the layout names the fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from curio_train.geometry import Pose, matrix_from_rotation_6d

Activation = Literal["linear", "tanh", "sigmoid", "perspective"]
SceneCode = Mapping[str, Tensor]

TRANSLATION = "translation_m"
ROTATION_6D = "rotation_6d"
YAW = "yaw_ij"
COLOR = "color"
CONFIDENCE = "confidence"
PRESENCE = "presence"
"""The probability that an object is in the image, which some networks answer beside the code."""
LIGHT = "light"


@dataclass(frozen=True)
class Field:
    """One field of the scene code."""

    name: str
    """Also the output's name in the exported graph, if the field is exported unchanged."""
    size: int
    """Values per object, or per scene."""
    per_object: bool = True
    """False for fields that a scene has once, such as light."""
    unit: str = "1"
    """"m", "image_width", "1"."""
    frame: str = ""
    """"camera", "world", "image", or "" where none applies."""
    activation: Activation = "linear"
    """How the head's raw output becomes the physical value, see :meth:`activate`."""
    lower: tuple[float, ...] = ()
    """Smallest value of each component, or empty where unbounded."""
    upper: tuple[float, ...] = ()
    """Largest value of each component, or empty where unbounded."""

    def __post_init__(self) -> None:
        """Refuse a range that does not fit the size."""
        if len(self.lower) != len(self.upper) or (self.lower and len(self.lower) != self.size):
            raise ValueError(
                f"field {self.name}: {len(self.lower)} lower and {len(self.upper)} upper bounds for size {self.size}"
            )
        if not self.lower and self.activation != "linear":
            raise ValueError(f"field {self.name}: activation {self.activation} needs a range")

    @property
    def span(self) -> tuple[float, ...]:
        """Width of each component's range, which metrics divide by (Eq. 1 with w = 1).

        It is 1 where unbounded, and where the range is a point (z of a 2D world), whose error is 0 anyway.
        """
        return tuple((u - low) or 1.0 for low, u in zip(self.lower, self.upper, strict=True)) or (1.0,) * self.size

    def activate(self, raw: Tensor) -> Tensor:
        """Raw head output ``[..., size]`` to physical values of the same shape.

        * ``linear``: 0 is the middle of the range and ±1 its ends, without a bound (the paper's heads);
        * ``tanh``, ``sigmoid``: bounded by the range;
        * ``perspective``: position as (x/z, y/z, z) with z in the logarithm, bounded softly by tanh, returned as
          (x, y, z). Its range is given in (x/z, y/z, z).
        """
        if not self.lower:
            return raw
        lower, upper = raw.new_tensor(self.lower), raw.new_tensor(self.upper)
        if self.activation == "linear":
            return (lower + upper) / 2 + raw * (upper - lower) / 2
        if self.activation == "tanh":
            return (lower + upper) / 2 + torch.tanh(raw) * (upper - lower) / 2
        if self.activation == "sigmoid":
            return lower + torch.sigmoid(raw) * (upper - lower)
        slope = (lower + upper)[:2] / 2 + torch.tanh(raw[..., :2]) * (upper - lower)[:2] / 2
        log_near, log_far = lower[2].log(), upper[2].log()
        depth = ((log_near + log_far) / 2 + torch.tanh(raw[..., 2:]) * (log_far - log_near) / 2).exp()
        return torch.cat([slope * depth, depth], dim=-1)

    def relative(self, value: Tensor) -> Tensor:
        """Physical values in units of the range, so that differences are Eq. 1's with w = 1.

        Shape ``[..., size]`` as given. Where the range is one of (x/z, y/z, z), so is the result.
        """
        if self.activation == "perspective":
            value = torch.cat([value[..., :2] / value[..., 2:], value[..., 2:]], dim=-1)
        return value / value.new_tensor(self.span)


@dataclass(frozen=True)
class Layout:
    """The fields of a world's scene code and the number of its object slots."""

    fields: tuple[Field, ...]
    num_slots: int = 1

    def __getitem__(self, name: str) -> Field:
        """The field of that name.

        Raises:
            KeyError: There is none.
        """
        for field in self.fields:
            if field.name == name:
                return field
        raise KeyError(f"no field {name!r} in the scene code; it has {[f.name for f in self.fields]}")

    def __contains__(self, name: str) -> bool:
        return any(field.name == name for field in self.fields)

    def shape(self, field: Field, batch: int) -> tuple[int, ...]:
        """Shape of that field's tensor for ``batch`` images."""
        return (batch, self.num_slots, field.size) if field.per_object else (batch, field.size)

    def activate(self, raw: SceneCode) -> dict[str, Tensor]:
        """Raw head outputs of all fields to the scene code, see :meth:`Field.activate`."""
        return {field.name: field.activate(raw[field.name]) for field in self.fields}

    def check(self, code: SceneCode) -> None:
        """Check that the names and shapes of a code are this layout's.

        Raises:
            ValueError: One differs.
        """
        if set(code) != {field.name for field in self.fields}:
            raise ValueError(f"scene code has {sorted(code)}, the layout {sorted(f.name for f in self.fields)}")
        for field in self.fields:
            found = tuple(code[field.name].shape)
            if found != self.shape(field, found[0]):
                raise ValueError(f"{field.name} has shape {found}, expected {self.shape(field, found[0])}")


def presence_of(code: SceneCode) -> Tensor:
    """The probability that each object is there, [batch, slots]: its confidence where no presence is answered."""
    return code.get(PRESENCE, code[CONFIDENCE])[..., 0]


def index(code: SceneCode, rows: Tensor | slice) -> dict[str, Tensor]:
    """The code of some images of the batch."""
    return {name: value[rows] for name, value in code.items()}


def of_slot(code: SceneCode, slot: int) -> dict[str, Tensor]:
    """Codes of one object alone: per-object fields [batch, 1, size], and what the whole scene has in common."""
    return {name: value[:, slot : slot + 1] if value.ndim == 3 else value for name, value in code.items()}


def joined(codes: Sequence[SceneCode]) -> dict[str, Tensor]:
    """The code of all images of several batches, at least one."""
    return {name: torch.cat([code[name] for code in codes]) for name in codes[0]}


def poses(code: SceneCode, slot: int = 0) -> list[Pose]:
    """cam_from_obj of the object in one slot of each image."""
    rotations = matrix_from_rotation_6d(code[ROTATION_6D][:, slot].double()).numpy()
    translations = code[TRANSLATION][:, slot].double().numpy()
    return [Pose(rotation, translation) for rotation, translation in zip(rotations, translations, strict=True)]
