"""A managed node of rclpy's that is gone once it was destroyed: `ManagedNode`."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode


class ManagedNode(LifecycleNode):
    """What a foreign managed node is to us, in this process.

    rclpy's own `destroy_node` forgets the state machine. That holds the services, the publisher of
    transitions and through the node the whole participant, until the garbage collector comes by:
    meanwhile a node of that name is in the graph of the next tests, answers nobody, and leaves in
    the middle of one.
    """

    def destroy_node(self) -> None:
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()
