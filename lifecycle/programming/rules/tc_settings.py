"""How one network device is to treat flows, and what its kernel can do.

Owns: the settings of the tc export. Pure.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import re
from collections.abc import Mapping, Sequence

OWNED_HANDLE = "1f10:"
"""The root qdisc with this handle is ours, whichever device it is on."""

DEFAULT_QUEUE_MS = 50.0
"""How long the queue of each class may become. Without a bound of its own it is a thousand packets
(txqueuelen): measured on a link of 20 Mbit/s at 120 % load, bulk then stood for 569 ms, and for
49 ms with this; a UDP datagram of 64 kB still arrives whole."""

MIN_QUEUE_BYTES = 66_000
"""Room for one UDP datagram of the largest size in its fragments: a shorter queue would let none
through, however often it is sent."""

QDISCS = ("htb", "prio")
CLASSIFIERS = ("flower", "u32")

_LONGEST_QUEUE_MS = 10_000
_DEVICE = re.compile(r"[^\s/:#]{1,15}")


class TcMatch(enum.Enum):
    """What filters look at."""

    FLOW = "flow"  # the 5-tuple: nothing has to be marked
    MARK = "mark"  # the DSCP: one filter per class, also for what others have marked


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcFeatures:
    """What the kernel of the device has; not every kernel has all of it, so probe.

    Attributes:
        qdiscs: of QDISCS.
        classifiers: of CLASSIFIERS.
    """

    qdiscs: tuple[str, ...] = QDISCS
    classifiers: tuple[str, ...] = CLASSIFIERS

    def classifier(self) -> str:
        """Return the classifier to use.

        Raises:
            ValueError: the kernel has none of them.
        """
        return _first(CLASSIFIERS, self.classifiers, "classifier", "cls_")

    def qdisc(self, link_kbit: int | None) -> str:
        """Return the queueing discipline to use: htb divides a rate, so it needs one.

        Raises:
            ValueError: the kernel has none of them.
        """
        wanted = QDISCS if link_kbit is not None else QDISCS[1:]
        try:
            return _first(wanted, self.qdiscs, "queueing discipline", "sch_")
        except ValueError as error:
            if link_kbit is None and "htb" in self.qdiscs:
                raise ValueError(f"{error}; with the rate of the link, htb will do") from None
            raise


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcSettings:
    """How a device is to treat the flows.

    Attributes:
        device: network device that the packets leave by, `eth0`.
        link_kbit: rate of the link behind it, kbit/s; None gives strict priority without rates.
        guaranteed_kbit: rates by class name (`ef`, `5qi85`), kbit/s; must be above burst peaks.
        match: what filters look at.
        queue_ms: how long the queue of each class may become, in the time that the link takes to
            send it, milliseconds, > 0; what finds it full is dropped. Only where there is a rate.
        features: of the kernel.
    """

    device: str
    link_kbit: int | None = None
    guaranteed_kbit: Mapping[str, int] = dataclasses.field(default_factory=dict)
    match: TcMatch = TcMatch.FLOW
    queue_ms: float = DEFAULT_QUEUE_MS
    features: TcFeatures = TcFeatures()

    def __post_init__(self) -> None:
        if not _DEVICE.fullmatch(self.device) or self.device in {".", ".."}:
            raise ValueError(
                f"cannot use device {self.device!r}; "
                f"use the name of a network device, such as eth0, of at most 15 characters"
            )
        if not 0 < self.queue_ms <= _LONGEST_QUEUE_MS:
            raise ValueError(
                f"cannot use a queue of {self.queue_ms:g} ms; use more than 0 and at most "
                f"{_LONGEST_QUEUE_MS}"
            )

    @property
    def queue_bytes(self) -> int | None:
        """How many bytes the queue of each class takes; None without a rate."""
        if self.link_kbit is None:
            return None
        return max(MIN_QUEUE_BYTES, math.ceil(self.link_kbit * self.queue_ms / 8))


def _first(wanted: Sequence[str], present: Sequence[str], what: str, module: str) -> str:
    for each in wanted:
        if each in present:
            return each
    modules = " or ".join(f"{module}{each}" for each in wanted)
    raise ValueError(
        f"cannot find a {what} in this kernel: {' or '.join(wanted)} would do; "
        f"load the module {modules}, or use a kernel that has it"
    )
