"""The bring-up benchmark's nodes started by launch_ros; nothing is verified.

Each node is configured when its process runs and activated when it is inactive, as in launch_ros'
own examples.

    python benchmarks/bring_up_launch.py NODES SHAPE

Prints `active` once all are, and ends on SIGINT.
"""

from __future__ import annotations

import sys
from pathlib import Path

import lifecycle_msgs.msg
from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessStart
from launch.events import matches_action
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState

PROGRAM = Path(__file__).with_name("bring_up_rclpy.py")
Transition = lifecycle_msgs.msg.Transition


def change(node: LifecycleNode, transition: int) -> EmitEvent:
    event = ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition)
    return EmitEvent(event=event)


def description(nodes: int, shape: str) -> LaunchDescription:
    active: set[int] = set()

    def note(_: LaunchContext, index: int) -> None:
        active.add(index)
        if len(active) == nodes:
            print("active", flush=True)

    actions: list[object] = []
    for index in range(nodes):
        node = LifecycleNode(
            executable=sys.executable,
            arguments=[str(PROGRAM), str(index), shape],
            name=f"node_{index}",
            namespace="",
        )
        configure = change(node, Transition.TRANSITION_CONFIGURE)
        activate = change(node, Transition.TRANSITION_ACTIVATE)
        noted = OpaqueFunction(function=note, args=[index])
        handlers = (
            OnProcessStart(target_action=node, on_start=[configure]),
            OnStateTransition(
                target_lifecycle_node=node, goal_state="inactive", entities=[activate]
            ),
            OnStateTransition(target_lifecycle_node=node, goal_state="active", entities=[noted]),
        )
        actions += [RegisterEventHandler(each) for each in handlers]
        actions.append(node)
    return LaunchDescription(actions)


def main() -> int:
    service = LaunchService(noninteractive=True)
    service.include_launch_description(description(int(sys.argv[1]), sys.argv[2]))
    return int(service.run())


if __name__ == "__main__":
    sys.exit(main())
