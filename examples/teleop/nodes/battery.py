"""The battery: publisher P2 of the article's example, a pack that empties as the robot drives."""

from __future__ import annotations

from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleState
from sensor_msgs.msg import BatteryState

from examples.teleop.models.battery import Load, Pack, discharged, resting
from examples.teleop.models.motion import STANDSTILL
from examples.teleop.nodes.messages import velocity_of
from lifecycle import LifecycleNode, on_message


class Battery(LifecycleNode):
    """Discharges by what the motors draw at the speed that odometry reports."""

    def on_configure(self, _state: LifecycleState) -> None:
        """Charge the pack to `initial_charge` and set the report timer."""
        self._pack = Pack(capacity_ah=self.get_parameter("capacity_ah").value)
        self._load = Load()
        self._charge = resting(self._pack, self.get_parameter("initial_charge").value)
        self._velocity = STANDSTILL
        rate_hz = self.get_parameter("rate_hz").value
        self._step_s = self.get_parameter("time_lapse").value / rate_hz
        self._timer = self.create_timer(1 / rate_hz, self._report)

    def on_cleanup(self, _state: LifecycleState) -> None:
        """Take back the timer, or configuring again would start a second one."""
        self.destroy_timer(self._timer)

    @on_message("odometry")
    def _take_load(self, message: Odometry) -> None:
        self._velocity = velocity_of(message.twist.twist)

    def _report(self) -> None:
        power_w = self._load.power_w(self._velocity)
        self._charge = discharged(self._pack, self._charge, power_w, self._step_s)
        message = BatteryState(
            voltage=self._charge.voltage_v,
            current=-self._charge.current_a,  # negative when discharging, says BatteryState
            charge=self._charge.fraction * self._pack.capacity_ah,
            capacity=self._pack.capacity_ah,
            design_capacity=self._pack.capacity_ah,
            percentage=self._charge.fraction,
            temperature=float("nan"),
            power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
            power_supply_health=BatteryState.POWER_SUPPLY_HEALTH_GOOD,
            power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
            present=True,
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher("battery").publish(message)
