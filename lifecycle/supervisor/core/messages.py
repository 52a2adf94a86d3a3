"""What happens to a run, and what is to be done: the inputs of `take`, the effects of `advance`.

An input is one fact, said once, by one port; an effect is answered by the input it names. Pure.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Condition, Readiness
from lifecycle.plan.comparison import GivenParameters
from lifecycle.supervisor.core.state import Level, Order, Step
from lifecycle.supervisor.run.events import Failure
from lifecycle.verify.verdict import Verdict

# Inputs


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """Time has passed.

    Attributes:
        at_s: until when the rest was measured; what is late by then is given up.
        waited_s: by node, seconds since its request in which its process had no CPU, and wanted it.
        where: by node whose request is late, what it is doing; what is not known is left out.
    """

    at_s: float = float("inf")
    waited_s: Mapping[str, float] = {}
    where: Mapping[str, str] = {}


class Spawned(msgspec.Struct, frozen=True, kw_only=True):
    """A process was started, or cannot be: `error`; `log` is the file with its output."""

    process: str
    pid: int = 0
    log: str = ""
    error: str = ""


class Exited(msgspec.Struct, frozen=True, kw_only=True):
    """A process has ended, by whatever cause; in whatever phase.

    Attributes:
        status: its exit status; None if a signal ended it, or it is not known.
        signal: number of the signal that ended it; 0 if none did.
        text: both for people, `exit status 1`.
        words: what it said of it; empty if nothing.
        stderr: the last line that it wrote there; empty if none.
        clean: it is an end that somebody asked for, as systemd.service(5) has it.
        crash: the program broke.
        reports: why it cannot host nodes, as it said: full name (or empty) and message.
    """

    process: str
    status: int | None = None
    signal: int = 0
    text: str = ""
    stderr: str = ""
    words: str = ""
    clean: bool = False
    crash: bool = False
    reports: tuple[tuple[str, str], ...] = ()


class Swept(msgspec.Struct, frozen=True, kw_only=True):
    """Nothing is left of a process that ended: what it started has ended, too.

    Attributes:
        reported: by node of others, the URLs of each of its connections, as it reports them.
    """

    process: str
    reported: Mapping[str, Mapping[str, tuple[str, ...]]] = {}


class Replied(msgspec.Struct, frozen=True, kw_only=True):
    """The request with this number was answered: the node is at `level`, or the step failed.

    Attributes:
        changed: it is not as it was verified, and was not activated: the gate is asked again.
        already: nothing was asked of it: it was there before.
    """

    node: str
    number: int
    level: Level
    error: str = ""
    changed: bool = False
    already: bool = False


class Saw(msgspec.Struct, frozen=True, kw_only=True):
    """What the graph, a host or another supervisor, unasked, shows of nodes; by key.

    Attributes:
        levels: of nodes of ours whose state others may change.
        health: whether nodes are healthy, as far as that is known.
        shown: what others wait for of nodes of ours, as far as the graph shows it.
        appeared: nodes that are in the graph now; what drives them may yet be missing.
        undeclared: nodes in the graph that the manifest does not declare; None if nothing is new.
        elsewhere: conditions that nodes of other supervisors have reached.
        left: full names of all nodes whose supervisor was shut down; None if nothing is new.
    """

    levels: Mapping[str, Level] = {}
    health: Mapping[str, bool] = {}
    shown: Mapping[str, frozenset[Readiness]] = {}
    appeared: frozenset[str] = frozenset()
    undeclared: frozenset[str] | None = None
    elsewhere: Mapping[str, frozenset[Condition | Readiness]] = {}
    left: frozenset[str] | None = None


class Changed(msgspec.Struct, frozen=True, kw_only=True):
    """Something that a verdict looks at may have changed."""


class Verified(msgspec.Struct, frozen=True, kw_only=True):
    """A look is over.

    Attributes:
        mark: of the moment at which it began.
        again_s: look again after so long, as nobody says when what is missing is there.
        waits: something is awaited that may speak against it: it opens nothing.
        away: full names of the nodes that were not as far as they are to be when it began.
    """

    mark: int
    verdict: Verdict
    again_s: float = float("inf")
    waits: bool = False
    away: frozenset[str] = frozenset()


class Programmed(msgspec.Struct, frozen=True, kw_only=True):
    """Networks have the flows of the verdict, or cannot be programmed; `number` is the effect's."""

    number: int
    error: str = ""


class Given(msgspec.Struct, frozen=True, kw_only=True):
    """A running node has taken parameters, or refuses them."""

    node: str
    error: str = ""


class Ordered(msgspec.Struct, frozen=True, kw_only=True):
    """Somebody ordered something; what does not fit the manifest was refused before."""

    order: Order


class Stop(msgspec.Struct, frozen=True, kw_only=True):
    """The run is to end: `lifecycle down`, a signal; `code`: of a run that is cut short by it.

    After an interrupt while the system is taken down nothing is asked politely any more.
    """

    reason: str
    code: ExitCode


class Silent(msgspec.Struct, frozen=True, kw_only=True):
    """A node is silent, or is not any more: `why` is empty.

    Attributes:
        away: nothing reaches it; one that only hangs may answer in time.
        hangs: it is stopped or hangs, for which its process's watchdog ends it.
    """

    node: str
    why: str = ""
    away: bool = False
    hangs: bool = False


class Refused(msgspec.Struct, frozen=True, kw_only=True):
    """Something was found, beside all looks, that closes the gate for good."""

    verdict: Verdict


class Broken(msgspec.Struct, frozen=True, kw_only=True):
    """Something failed that is no node's: the discovery server died, the fork server died."""

    failure: Failure


Input = (
    Tick | Spawned | Exited | Swept | Replied | Saw | Changed | Verified | Programmed | Given
    | Ordered | Stop | Silent | Refused | Broken
)  # fmt: skip


# Effects


class Spawn(msgspec.Struct, frozen=True, kw_only=True):
    """Start a process; `Spawned`, and later one `Exited`."""

    process: str


class Signal(msgspec.Struct, frozen=True, kw_only=True):
    """Send a process a signal; 0: close its control channel, by which a host of ours ends."""

    process: str
    number: int


class Sweep(msgspec.Struct, frozen=True, kw_only=True):
    """End what a process left; `Swept`."""

    process: str


class Ask(msgspec.Struct, frozen=True, kw_only=True):
    """Ask a node for a step; `Replied` with its number: one that was given up is nobody's.

    ACTIVATE may leave only while the gate is open, else `Replied(changed)`.
    """

    node: str
    step: Step
    number: int


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
    """Answer an order, by its number."""

    order: int
    code: ExitCode
    error: str = ""


class Wake(msgspec.Struct, frozen=True, kw_only=True):
    """Send a `Tick` at this time, if nothing happens before."""

    at_s: float


Effect = Spawn | Signal | Sweep | Ask | Look | Program | Give | Answer | Wake
