"""Kalman filter of a pose on SE(3) with constant velocity.

Position and velocity are in the camera's frame. The rotation's error is a rotation vector in the camera's frame, small
between frames, with its angular velocity beside it (an error-state filter, Solà 2017). The covariance of a measurement
is the network's own spread. While measurements agree with constant velocity, the process noise is that of small
accelerations, so that the pose does not tremble at rest. Where a measurement contradicts it, the filter adds process
noise, so that the pose does not lag behind a sudden movement.
"""

import numpy as np

from curio_serve.imaging.rotation import from_rotation_vector, rotation_vector

Array = np.ndarray
_ACCELERATION_M_S2, _ANGULAR_ACCELERATION_RAD_S2 = 0.06, 0.4  # standard deviations, while measurements agree
_FIRST_SPEED_M_S, _FIRST_TURN_RAD_S = 0.7, 1.5  # of an object that was just found
_SURPRISE = 4.0  # mean squared normalised innovation above which process noise is added
_MOST_ADDED = 1e6  # times the process noise of a frame
_LEAST_M, _LEAST_RAD = 0.5e-3, 0.5e-2  # standard deviations that no measurement is better than
_DAMPING_S = 0.5  # an object that nobody sees is soon expected to stand still


class PoseFilter:
    """Mean and covariance of a pose and its velocity."""

    def __init__(self, translation_m: Array, rotation: Array, covariance_m2: Array, rotation_variance: float) -> None:
        """Begin with a first measurement; see :meth:`update`."""
        self.translation_m, self.velocity_m_s = np.array(translation_m, float), np.zeros(3)
        self.rotation, self.turn_rad_s = np.array(rotation, float), np.zeros(3)
        self._linear = _first(_floored(covariance_m2), _FIRST_SPEED_M_S)
        self._angular = _first(np.eye(3) * max(rotation_variance, _LEAST_RAD**2), _FIRST_TURN_RAD_S)
        self._elapsed_s = 0.0

    @property
    def position_std_m(self) -> Array:
        """Standard deviations of the position [3]."""
        result: Array = np.sqrt(np.diag(self._linear)[:3])
        return result

    @property
    def rotation_std_rad(self) -> float:
        """Standard deviation of the rotation about an axis."""
        return float(np.sqrt(np.diag(self._angular)[:3].mean()))

    def predict(self, seconds: float, *, seen: bool = True) -> None:
        """Predict the state at a later time.

        Args:
            seconds: Not negative.
            seen: Whether the object was seen in the last frame; if not, its velocity decays.
        """
        if not seen:
            fading = float(np.exp(-seconds / _DAMPING_S))
            self.velocity_m_s *= fading
            self.turn_rad_s *= fading
        self.translation_m += seconds * self.velocity_m_s
        self.rotation = from_rotation_vector(seconds * self.turn_rad_s) @ self.rotation
        self._linear = _moved(self._linear, seconds, _ACCELERATION_M_S2)
        self._angular = _moved(self._angular, seconds, _ANGULAR_ACCELERATION_RAD_S2)
        self._elapsed_s = seconds

    def update(self, translation_m: Array, covariance_m2: Array) -> None:
        """Update with a measured position.

        Args:
            translation_m: [3], camera frame.
            covariance_m2: [3, 3].
        """
        innovation = translation_m - self.translation_m
        noise = _floored(covariance_m2)
        correction, self._linear = _corrected(self._linear, innovation, noise, self._elapsed_s, _ACCELERATION_M_S2)
        self.translation_m += correction[:3]
        self.velocity_m_s += correction[3:]

    def update_rotation(self, rotation: Array, variance: float) -> None:
        """Update with a measured rotation cam_from_obj [3, 3] and its variance about each axis, rad²."""
        innovation = rotation_vector(rotation @ self.rotation.T)
        noise = np.eye(3) * max(variance, _LEAST_RAD**2)
        correction, self._angular = _corrected(
            self._angular, innovation, noise, self._elapsed_s, _ANGULAR_ACCELERATION_RAD_S2
        )
        self.rotation = from_rotation_vector(correction[:3]) @ self.rotation
        self.turn_rad_s += correction[3:]

    def replace_position(self, translation_m: Array, covariance_m2: Array) -> None:
        """Restart with another position; the rotation stays."""
        self.translation_m, self.velocity_m_s = np.array(translation_m, float), np.zeros(3)
        self._linear = _first(_floored(covariance_m2), _FIRST_SPEED_M_S)

    def replace_rotation(self, rotation: Array, variance: float) -> None:
        """Restart with another rotation; position and velocity stay."""
        self.rotation, self.turn_rad_s = np.array(rotation, float), np.zeros(3)
        self._angular = _first(np.eye(3) * max(variance, _LEAST_RAD**2), _FIRST_TURN_RAD_S)


def _first(noise: Array, speed: float) -> Array:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = noise
    covariance[3:, 3:] = np.eye(3) * speed**2
    return covariance


def _floored(covariance_m2: Array) -> Array:
    result: Array = covariance_m2 + np.eye(3) * _LEAST_M**2
    return result


def _process(seconds: float, acceleration: float) -> Array:
    """Process noise covariance of a random acceleration that is constant from frame to frame."""
    gain = np.array([seconds**2 / 2, seconds])
    result: Array = np.kron(np.outer(gain, gain), np.eye(3)) * acceleration**2
    return result


def _moved(covariance: Array, seconds: float, acceleration: float) -> Array:
    step = np.eye(6)
    step[:3, 3:] = np.eye(3) * seconds
    result: Array = step @ covariance @ step.T + _process(seconds, acceleration)
    return result


def _corrected(
    covariance: Array, innovation: Array, noise: Array, seconds: float, acceleration: float
) -> tuple[Array, Array]:
    """The correction [6] that a measurement of the first three values makes, and the covariance after it."""
    expected = covariance[:3, :3] + noise
    surprise = float(innovation @ np.linalg.solve(expected, innovation)) / 3
    if surprise > _SURPRISE:
        covariance = covariance + _process(seconds, acceleration) * min((surprise / _SURPRISE) ** 2 * 100, _MOST_ADDED)
        expected = covariance[:3, :3] + noise
    gain = covariance[:, :3] @ np.linalg.inv(expected)
    kept = np.eye(6)
    kept[:, :3] -= gain
    # Joseph's form: stays symmetric and positive whatever is rounded.
    return gain @ innovation, kept @ covariance @ kept.T + gain @ noise @ gain.T
