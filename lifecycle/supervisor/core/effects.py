"""What is to be done: the effects of `advance`. Each is answered by the input it names. Pure."""

from __future__ import annotations

import msgspec

from lifecycle.errors import ExitCode
from lifecycle.plan.comparison import GivenParameters
from lifecycle.supervisor.core.state import Step
from lifecycle.verify.verdict import Verdict


class Spawn(msgspec.Struct, frozen=True, kw_only=True):
    """Start a process; `Spawned`, and later one `Exited`."""

    process: str


class Signal(msgspec.Struct, frozen=True, kw_only=True):
    """Send a process a signal; 0: close its control channel, by which a host of ours ends."""

    process: str
    number: int


class Sweep(msgspec.Struct, frozen=True, kw_only=True):
    """End what a process left, and wait until the graph has forgotten its nodes; `Swept`."""

    process: str


class Ask(msgspec.Struct, frozen=True, kw_only=True):
    """Ask a node for a step; `Replied`.

    Attributes:
        number: given back in the answer: one to a request that was given up is nobody's.
        mark: for ACTIVATE: it may leave only while this is the run's mark, else `Replied(changed)`.
    """

    node: str
    step: Step
    number: int
    mark: int = -1


class Look(msgspec.Struct, frozen=True, kw_only=True):
    """Observe and judge; `Verified`, with the mark at which it began: this one, or a later one."""

    mark: int


class Program(msgspec.Struct, frozen=True, kw_only=True):
    """Program networks with the flows of a verdict; `Programmed` with the same number."""

    verdict: Verdict
    number: int


class Give(msgspec.Struct, frozen=True, kw_only=True):
    """Set parameters of a running node, None for all of its mode; `Given`."""

    node: str
    values: GivenParameters | None = None


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """Answer an order."""

    order: int
    code: ExitCode
    error: str = ""


class Wake(msgspec.Struct, frozen=True, kw_only=True):
    """Send a `Tick` at this time, if nothing happens before."""

    at_s: float


Effect = Spawn | Signal | Sweep | Ask | Look | Program | Give | Answer | Wake
