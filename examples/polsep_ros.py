"""A ROS 2 node: raw frames of a polarization camera in, diffuse and specular images out. Not run under ROS yet.

    python examples/polsep_ros.py --ros-args -r image_raw:=/camera/image_raw -p white_level:=4095.0 -p layout:=color

It subscribes to ``image_raw`` (sensor_msgs/Image in mono8, mono16, bayer_rggb8 or bayer_rggb16) and publishes
``diffuse`` and ``specular`` in 32FC3, of mono sensors 32FC1: linear light of half the size, 1.0 = one measurement at
the white level. Each has the header of its frame. The stream function of `color-affine` separates,
of mono sensors that of `analytic`; frames that come meanwhile are dropped, as the quality of service for sensors says.
"""

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

import polsep
from polsep.kernels import (
    AnalyticImages,
    AnalyticOptions,
    ColorAffineImages,
    ColorAffineOptions,
    separate_analytic_half,
    separate_color_affine_half,
)

#: Types of samples by the encoding of messages.
TYPES = {"mono8": "u1", "bayer_rggb8": "u1", "mono16": "u2", "bayer_rggb16": "u2"}


def samples_of(message):
    """The mosaic [H, W] of a message, uint8 or uint16. Raises ValueError on other encodings."""
    if message.encoding not in TYPES:
        raise ValueError(f"expected an encoding of {', '.join(TYPES)}, found {message.encoding!r}")
    kind = np.dtype(TYPES[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    samples = rows[:, : message.width * kind.itemsize].copy().view(kind)
    return samples.astype(kind.newbyteorder("="), copy=False)


def message_of(image, header):
    """An image [h, w, C] of float32 as a message."""
    height, width, channels = image.shape
    message = Image(header=header, height=height, width=width, encoding=f"32FC{channels}", step=4 * width * channels)
    message.data = image.astype("<f4", copy=False).tobytes()
    return message


def stream_of(size, layout):
    """The stream function for a layout, `color-affine` or of mono sensors `analytic`, and images that it fills."""
    if layout.bayer is None:
        return separate_analytic_half, AnalyticOptions(out=AnalyticImages.empty(size, layout))
    return separate_color_affine_half, ColorAffineOptions(out=ColorAffineImages.empty(size, layout), guided=True)


class Separator(Node):
    """The node; its images are filled again and again."""

    def __init__(self):
        super().__init__("polsep")
        self.layout = polsep.Layout.parse(self.declare_parameter("layout", "color").value)
        self.black = self.declare_parameter("black_level", 0.0).value
        self.white = self.declare_parameter("white_level", 0.0).value  # 0: the largest value of the type
        self.size = None
        self.outputs = {
            name: self.create_publisher(Image, name, qos_profile_sensor_data) for name in ("diffuse", "specular")
        }
        self.create_subscription(Image, "image_raw", self.separate, qos_profile_sensor_data)

    def separate(self, message):
        """Publish the images of a frame; what is wrong with one is logged, and the next is tried."""
        try:
            raw = samples_of(message)
            if self.size != raw.shape:
                (self.run, self.options), self.size = stream_of(raw.shape, self.layout), raw.shape
            white = self.white or float(np.iinfo(raw.dtype).max)
            images = self.run(raw, self.layout, self.black, white, self.options)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        for name, output in self.outputs.items():
            output.publish(message_of(getattr(images, name), message.header))


def main():
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(Separator())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
