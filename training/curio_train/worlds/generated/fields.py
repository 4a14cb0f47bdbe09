"""Fields of scene codes that several worlds have."""

import numpy as np

from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, YAW, Field

LOWEST_SUN_DEG, HIGHEST_SUN_DEG = 30.0, 80.0
"""Elevation of the sun in worlds in which it moves."""
_REACH = 1 / float(np.tan(np.radians(LOWEST_SUN_DEG)))

COLOR_FIELD = Field(COLOR, 3, activation="sigmoid", lower=(0.0,) * 3, upper=(1.0,) * 3)
CONFIDENCE_FIELD = Field(CONFIDENCE, 1, activation="sigmoid", lower=(0.0,), upper=(1.0,))
YAW_FIELD = Field(YAW, 2, frame="world", activation="tanh", lower=(-1.0, -1.0), upper=(1.0, 1.0))
ROTATION_FIELD = Field(ROTATION_6D, 6, frame="world", lower=(-1.0,) * 6, upper=(1.0,) * 6)
SUN_FIELD = Field(LIGHT, 2, per_object=False, frame="world", lower=(-_REACH, -_REACH), upper=(_REACH, _REACH))
