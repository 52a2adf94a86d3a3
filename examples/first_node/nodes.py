"""A node that says something and a node that hears it."""

from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message, on_timer


class Talker(LifecycleNode):
    """Greets twice a second while it is active."""

    @on_timer(period_s=0.5)
    def speak(self) -> None:
        greeting = self.get_parameter("greeting").value
        self.publisher("chatter").publish(String(data=f"{greeting}, world"))


class Listener(LifecycleNode):
    """Logs what it hears while it is active."""

    @on_message("chatter")
    def hear(self, message: String) -> None:
        self.get_logger().info(f"I heard: {message.data}")
