"""A lithium-ion pack under load: charge counting, open-circuit voltage, internal resistance.

Owns: how much current a load draws and what is left afterwards. Pure.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

from examples.teleop.models.motion import Velocity

_OPEN_CIRCUIT_V = (
    (0.0, 3.00),
    (0.05, 3.35),
    (0.10, 3.50),
    (0.25, 3.62),
    (0.50, 3.73),
    (0.75, 3.92),
    (0.90, 4.06),
    (1.0, 4.20),
)
"""Open-circuit volts of one cell by state of charge: the usual shape of an NMC cell, steep at the
empty end and flat in the middle. Typical values, not one product's data sheet."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Pack:
    """The pack as built.

    Attributes:
        cells: in series.
        capacity_ah: of a full pack, ampere hours.
        resistance_ohm: internal, of the whole pack.
    """

    cells: int = 4
    capacity_ah: float = 5.0
    resistance_ohm: float = 0.08


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What the robot draws: W at rest, and on top W per m/s of driving and per rad/s of turning."""

    idle_w: float = 12.0
    per_mps_w: float = 60.0
    per_radps_w: float = 10.0

    def power_w(self, velocity: Velocity) -> float:
        """Return the electric power at this velocity, in W."""
        driving_w = self.per_mps_w * abs(velocity.forward_mps)
        return self.idle_w + driving_w + self.per_radps_w * abs(velocity.turn_radps)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Charge:
    """The pack at one moment.

    Attributes:
        fraction: state of charge, 0 to 1.
        voltage_v: at the terminals, so it sags under load.
        current_a: drawn from the pack, >= 0.
    """

    fraction: float
    voltage_v: float
    current_a: float = 0.0


def open_circuit_voltage(pack: Pack, fraction: float) -> float:
    """Return the pack's voltage without load at a state of charge, clamped to 0..1."""
    fraction = max(0.0, min(1.0, fraction))
    for (low, low_v), (high, high_v) in itertools.pairwise(_OPEN_CIRCUIT_V):
        if fraction <= high:
            share = (fraction - low) / (high - low)
            return pack.cells * (low_v + share * (high_v - low_v))
    return pack.cells * _OPEN_CIRCUIT_V[-1][1]


def resting(pack: Pack, fraction: float) -> Charge:
    """Return the pack at a state of charge with nothing connected."""
    return Charge(fraction=fraction, voltage_v=open_circuit_voltage(pack, fraction))


def discharged(pack: Pack, charge: Charge, power_w: float, duration_s: float) -> Charge:
    """Return the pack after delivering `power_w` for `duration_s`.

    The current follows from power = current * (open circuit voltage - current * resistance); a load
    beyond what the pack can deliver gets that maximum. An empty pack delivers nothing.
    """
    if charge.fraction <= 0:
        return resting(pack, 0.0)
    source_v = open_circuit_voltage(pack, charge.fraction)
    room = source_v**2 - 4 * pack.resistance_ohm * power_w
    current_a = (source_v - math.sqrt(max(0.0, room))) / (2 * pack.resistance_ohm)
    used = current_a * duration_s / 3600 / pack.capacity_ah
    return Charge(
        fraction=max(0.0, charge.fraction - used),
        voltage_v=source_v - current_a * pack.resistance_ohm,
        current_a=current_a,
    )
