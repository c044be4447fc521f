"""A robot without ROS: an action that drives it by ROS's topics, a transform and a service.

It needs `pip install "fibaction[cli,ros-types]"`; at `ros2://drive_base` it goes through rclpy.

    python drive_base.py dds://drive_base tcp://127.0.0.1:7400
    fibaction -u tcp://127.0.0.1:7400 send_goal drive "meters: 2.0"
"""

import sys
from contextlib import suppress

import anyio

from fibaction import Report, action, serve
from fibaction_transports.ros2 import Node, open_node


class Base:
    """A robot with wheels."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.velocity = node.publisher("cmd_vel", "geometry_msgs/msg/Twist")
        self.odometry = node.subscribe("odom", "nav_msgs/msg/Odometry", depth=1)  # the newest one

    @action
    async def drive(self, report: Report[float], meters: float, speed: float = 0.5) -> list[float]:
        """Drive straight ahead, and return the position in the map at the end."""
        await self.node.call("enable_motors", "std_srvs/srv/SetBool", {"data": True}, timeout=5)
        start, driven = await self.position(), 0.0
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self.move, speed)
                while driven < meters:
                    await report(driven := await self.position() - start)
                tasks.cancel_scope.cancel()
        finally:
            await self.velocity.publish({})  # stop, also if the goal is canceled or fails
        return [*(await self.node.transform("base_link", "map", timeout=1))[:2]]

    async def move(self, speed: float) -> None:
        while True:
            await self.velocity.publish({"linear": {"x": speed}})
            await anyio.sleep(0.02)

    async def position(self) -> float:
        return float((await self.odometry.next(timeout=1)).pose.pose.position.x)


async def main(at: str, addresses: list[str]) -> None:
    """Open the node, and serve the action until Ctrl-C."""
    async with open_node(at) as node, serve(Base(node), *addresses) as served:
        print(f"{node.name} serves drive at {', '.join(served)}", flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    at, *addresses = sys.argv[1:] or ["dds://drive_base", "tcp://127.0.0.1:7400"]
    with suppress(KeyboardInterrupt):
        anyio.run(main, at, addresses)
