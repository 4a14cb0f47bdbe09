"""Layers over each other: per ray sample, by depth, attenuated by confidence; with confidence 1 exact occlusion.

Paper, section "Differentiable Rendering with Confidence". A hit's weight is its confidence times what all nearer hits
of the same sample let through, so the colour of a sample is ``background + Σ weight · (color − background)``: every hit
can be added to the image by itself.
"""

from types import ModuleType
from typing import Any

from curio_train.rendering.instances import Instances
from curio_train.rendering.pixels import ImageLocation


class Occlusion:
    """Depth of every slot at every sample that hits anything."""

    def __init__(self, mi: ModuleType, dr: ModuleType, num_slots: int, per_group: int) -> None:
        """Prepare for samples in groups (pixels) of ``per_group``; only groups with a hit cost memory."""
        self.mi, self.dr, self.num_slots, self.per_group = mi, dr, num_slots, per_group
        self.table: Any = None
        self.entry_of_group: Any = None

    def build(self, location: ImageLocation, depth_m: Any, num_groups: int) -> None:
        """Enter hits at their depths."""
        mi, dr = self.mi, self.dr
        group = location.sample // self.per_group
        self.entry_of_group = dr.zeros(mi.UInt32, num_groups)
        dr.scatter(self.entry_of_group, mi.UInt32(1), group)
        used = dr.compress(self.entry_of_group > 0)
        dr.scatter(self.entry_of_group, dr.arange(mi.UInt32, len(used)), used)
        self.table = dr.full(mi.Float, dr.inf, len(used) * self.per_group * self.num_slots)
        dr.scatter(self.table, depth_m, self._first_entry(location) + location.instance % self.num_slots)
        dr.eval(self.entry_of_group, self.table)

    def weight(self, instances: Instances, location: ImageLocation, depth_m: Any) -> Any:
        """Weight of a hit in its sample: its confidence times the transmittance of the nearer hits.

        Written without a sort: every slot is asked whether it is nearer (equal depths: the earlier slot), so the
        program does not depend on the data.
        """
        weight = instances.confidence(location.instance)
        if self.num_slots == 1:
            return weight
        image = location.instance // self.num_slots
        own, first = location.instance - image * self.num_slots, self._first_entry(location)
        for slot in range(self.num_slots):
            other = self.dr.gather(self.mi.Float, self.table, first + slot)
            nearer = (other < depth_m) | ((other == depth_m) & (slot < own))
            confidence = instances.confidence(image * self.num_slots + slot)
            weight *= self.dr.select(nearer, 1 - confidence, 1)
        return weight

    def _first_entry(self, location: ImageLocation) -> Any:
        group = location.sample // self.per_group
        entry = self.dr.gather(self.mi.UInt32, self.entry_of_group, group)
        return (entry * self.per_group + location.sample - group * self.per_group) * self.num_slots
