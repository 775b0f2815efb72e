"""A robot of a team as a node of ROS 2: one on every machine, with its own file and the key.

python ros2_node.py --ros-args -p name:=a -p team:="[a, b]" -p key:=team.key -p file:=a.g2o
"""

import time
from array import array
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

import solvers


class TeamNode(Node):
    """One topic a robot. Messages may be lost, late or repeated; the robot asks again."""

    def __init__(self) -> None:
        super().__init__("pgo_robot")
        defaults = {"name": "a", "team": ["a", "b"], "key": "team.key", "file": "a.g2o"}
        name, team, key, file = (self.declare_parameter(*item).value for item in defaults.items())
        self.robot = solvers.Robot(name, list(team), Path(key).read_bytes())
        self.robot.read(file)  # or add_pose and add_edge, as they are measured
        self.others = {
            other: self.create_publisher(UInt8MultiArray, f"/pgo/{other}", 100)
            for other in self.robot.others
        }
        self.create_subscription(UInt8MultiArray, f"/pgo/{name}", self.on_message, 100)
        self.create_timer(0.25, self.on_timer)

    def on_message(self, message: UInt8MultiArray) -> None:
        """Receive, then tick and send: an answer does not wait for the timer."""
        self.robot.receive(bytes(message.data), time.monotonic())
        self.on_timer()

    def on_timer(self) -> None:
        """Let the robot see the time, and send what it has to say."""
        self.robot.tick(time.monotonic())
        for message in self.robot.outbox():
            data = array("B", message.data)
            self.others[message.to].publish(UInt8MultiArray(data=data))


def main() -> None:
    """Run the node; Ctrl-C writes the poses found."""
    rclpy.init()
    node = TeamNode()
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)  # one thread makes all calls
    node.robot.write(f"{node.robot.name}.solved.g2o")


if __name__ == "__main__":
    main()
