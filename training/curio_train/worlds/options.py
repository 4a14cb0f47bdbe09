"""What a user may choose about each world, as plain data without torch: the command line's flags."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WorldOptions:
    """Base of the options of all worlds."""


@dataclass(frozen=True)
class CirclesOptions(WorldOptions):
    """A red circle of constant size on black: 2D position alone. Needs no data."""
