"""The controls of curio-view's page."""

import socket

import numpy as np
import viser
from curio_train.drawing.scenes import Placed, Scene
from curio_train.geometry import Pose
from curio_train.viewing.panel import Panel
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 320, 240
K = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
TRUE = Pose(Rotation.from_euler("xyz", [160, 35, 10], degrees=True).as_matrix(), np.array([0.01, 0.02, 0.6]))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def test_values_that_are_shown_and_not_changed_keep_all_their_digits() -> None:
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    try:
        panel = Panel(server.gui)
        for confidence in (0.004, 0.823746, 0.5):
            item = Placed("chair", TRUE, (0.64, 0.2, 0.19), confidence)
            scene = Scene("photograph", WIDTH, HEIGHT, K, (item,), None)
            panel.show_page(0, 1, scene)
            panel.show_values(scene, np.zeros(3), 0)
            kept = panel.edited(item)
            assert (kept.confidence, kept.color_srgb) == (confidence, item.color_srgb)
            assert kept.pose.rotation is item.pose.rotation
            panel.confidence.value = 0.25
            assert panel.edited(item).confidence == 0.25
            x, y, z = panel.rotation.value
            panel.rotation.value = (round(x, 1), round(y, 1), round(z, 1))  # as browsers give it back
            assert panel.edited(item).pose.rotation is item.pose.rotation
            panel.rotation.value = (x, y + 0.1, z)  # one step of its arrow
            turned = Rotation.from_rotvec((x, y + 0.1, z), degrees=True).as_matrix()
            np.testing.assert_allclose(panel.edited(item).pose.rotation, turned, atol=1e-12)
    finally:
        server.stop()
