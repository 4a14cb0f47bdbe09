"""A ROS 2 node that asks curio-serve for the poses in each image: vision_msgs/Detection3DArray on ~/detections.

    curio-serve models/
    python pose_bridge.py --ros-args -p model:=ape -r image:=/camera/image_raw -r camera_info:=/camera/camera_info

It needs rclpy, message_filters, sensor_msgs and vision_msgs of ROS 2, and `pip install curio-pose`. Raw images are
taken with K and the distortion of their camera_info, rectified ones (image:=/camera/image_rect) with P; which they are
the name of their topic says. Of images that come while the server answers another one, the newest alone waits.
"""

import rclpy
from curio_serve.client import PoseClient
from curio_serve.errors import CurioError
from curio_serve.imaging.camera_files import camera_of_images
from curio_serve.imaging.image import from_raw
from message_filters import Subscriber, TimeSynchronizer
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

FORMATS = {"rgb8": "RGB8", "bgr8": "BGR8", "mono8": "GRAY8"}
_NUM_INFOS = 10  # that wait for their image


class PoseBridge(Node):
    """Subscribes image and camera_info, which come with the same stamp, and publishes what is found."""

    def __init__(self) -> None:
        super().__init__("pose_bridge")
        self._model = self.declare_parameter("model", "ape").value
        self._min_confidence = self.declare_parameter("min_confidence", 0.5).value
        self._client = PoseClient(self.declare_parameter("address", "127.0.0.1:8500").value, timeout_s=2.0)
        self._publisher = self.create_publisher(Detection3DArray, "~/detections", 10)
        self._topic = self.resolve_topic_name("image")
        # Best effort, as of sensor data, gets what drivers publish, be it best effort or reliable. Where images are
        # rectified, several camera_info come before the image that they belong to.
        topics = ((Image, "image", 1), (CameraInfo, "camera_info", _NUM_INFOS))
        inputs = [
            Subscriber(self, kind, name, qos_profile=QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT))
            for kind, name, depth in topics
        ]
        self._pairs = TimeSynchronizer(inputs, queue_size=_NUM_INFOS)
        self._pairs.registerCallback(self._answer)

    def _answer(self, image: Image, info: CameraInfo) -> None:
        if image.encoding not in FORMATS:
            self.get_logger().error(f"encoding {image.encoding!r}, expected {', '.join(FORMATS)}", once=True)
            return
        try:
            camera = camera_of_images(info, self._topic)
            frame = from_raw(bytes(image.data), FORMATS[image.encoding], image.width, image.height, image.step)
            answer = self._client.detect(self._model, frame.pixels, camera, min_confidence=self._min_confidence)
        except CurioError as exc:
            self.get_logger().error(str(exc), throttle_duration_sec=5.0)
            return
        message = Detection3DArray(header=image.header)
        message.detections = [
            _detection(found, image.header) for result in answer.results for found in result.detections
        ]
        self._publisher.publish(message)


def _detection(found, header) -> Detection3D:
    """A pose as cam_from_obj; the bounding box stays empty."""
    hypothesis = ObjectHypothesisWithPose()
    hypothesis.hypothesis.class_id, hypothesis.hypothesis.score = found.object, found.confidence
    pose = hypothesis.pose.pose
    pose.position.x, pose.position.y, pose.position.z = found.translation_m
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = found.quaternion_xyzw or (0.0, 0.0, 0.0, 1.0)
    detection = Detection3D(header=header, results=[hypothesis])
    detection.bbox.center = pose
    return detection


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    rclpy.spin(PoseBridge())


if __name__ == "__main__":
    main()
