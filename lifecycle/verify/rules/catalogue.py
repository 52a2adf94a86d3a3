"""What a verification rule is: its id, outcomes, fix, and when its findings clear.

Owns: `Rule`, which makes the findings that carry its id, and the rules about the run itself, which
no check of an observation finds: the supervisor puts those findings into the run's last verdict.
Code that acts on findings asks their rules and does not parse ids, subjects or messages. Pure.
"""

from __future__ import annotations

import enum
from typing import Any

import msgspec

from lifecycle.manifest.diagnostics import Position
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import Actual, FlowView


class Heals(enum.Enum):
    """What takes a finding back."""

    WITH_TIME = "with time"  # a system on its way up breaks the rule for a moment
    WITH_CHANGE = "with change"  # something has to be changed
    NEVER = "never"  # no second look can show anything else


class About(enum.Enum):
    """What a rule looks at that a node brings along: it is broken while the node is not there."""

    PRESENCE = "presence"  # whether the node itself, or an endpoint of it, is there and alive
    MATCH = "match"  # whether two ends are matched: no node reports all of that
    PROGRESS = "progress"  # how far a node has come: its state, its report
    CONNECTION = "connection"  # a node's connections, and what is mapped onto them


class Rule(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that verification judges.

    Attributes:
        id: `family.name`, stable for ever; a section of docs/rules.md.
        meaning: what a finding of it says, one line.
        fix: what to do about it, one line.
        outcomes: the outcomes that it can have besides ok.
        says: message of a violated finding, made of `{who}`, `{expected}` and `{observed}`.
        unproven: likewise of an unverifiable one.
        concerns_flow: a finding on an endpoint also spoils the flows of that endpoint.
        may_block: False for a rule whose unverifiable findings never close the gate, because the
            manifest waived the requirement itself.
        heals: what takes its findings back.
        about: what it looks at that a node brings along; None for anything else.
        if_undiscovered: it breaks where one participant does not discover another.
        awaits: for a rule whose findings say that something is not known (yet), the rule that is
            broken while what would show it is not there; None for others.
        numbers: it is about a declared number, without which its subjects mean nothing.
        measured: it compares what is declared with what has arrived: it never closes a gate.
        names_log: its fix is in a log, and ends in the name of the file where that is known.
    """

    id: str
    meaning: str
    fix: str
    outcomes: tuple[Outcome, ...] = (Outcome.VIOLATED,)
    says: str = "{who} is {observed}, and must be {expected}"
    unproven: str = "nothing shows that {who} is {expected}: {observed}"
    concerns_flow: bool = False
    may_block: bool = True
    heals: Heals = Heals.WITH_CHANGE
    about: About | None = None
    if_undiscovered: bool = False
    awaits: Rule | None = None
    numbers: bool = False
    names_log: bool = False
    measured: bool = False

    @property
    def family(self) -> str:
        """What its id begins with: `on_violation` names families."""
        return self.id.partition(".")[0]

    def finding(
        self,
        *,
        subject: str,
        expected: str,
        observed: str,
        outcome: Outcome | None = None,
        who: str = "",
        message: str = "",
        at: Position | None = None,
        hint: str = "",
        **fields: Any,
    ) -> Finding:
        """Make a finding of this rule, with the only outcome that it has where none is given.

        `message` is made of `says` and `who`, which defaults to the subject; `hint` defaults to the
        rule's fix. `fields`: others of Finding.

        Raises:
            ValueError: the rule is not documented to have this outcome, or has several.
        """
        if outcome is None:
            (outcome,) = self.outcomes
        if outcome not in self.outcomes:
            raise ValueError(f"cannot give rule {self.id} the outcome {outcome.value}")
        says = self.says if outcome is Outcome.VIOLATED else self.unproven
        words = {"who": who or subject, "expected": expected, "observed": observed}
        return Finding(
            rule=self.id,
            outcome=outcome,
            subject=subject,
            expected=expected,
            observed=observed,
            message=message or says.format_map(words),
            at=at.spelled if at else "",
            hint=hint or self.fix,
            **fields,
        )

    def on(self, what: PlannedNode | Actual | FlowView, **fields: Any) -> Finding:
        """Make a finding on a declared node, endpoint or flow, at its declaration; as `finding`."""
        if isinstance(what, FlowView):
            named: dict[str, Any] = {"subject": what.subject, "who": what.where, "ends": what.ends}
        elif isinstance(what, PlannedNode):
            name = what.full_name
            named = {"subject": name, "who": f"node {name}", "node": name}
        else:
            end = {"node": what.node, "endpoint": what.kind}
            named = {"subject": what.name, "who": what.where, **end}
        return self.finding(**{"at": what.at, **named, **fields})


PROCESS_DIED = Rule(
    id="run.process-died",
    meaning="a process of the system ended although nobody asked it to, or died when asked to",
    fix="look at the last lines of its log",
    names_log=True,
)
GAVE_UP = Rule(
    id="run.gave-up",
    meaning="a process failed too often to be started again",
    fix="see what it failed of each time, in the message and in its log",
    names_log=True,
)
START_FAILED = Rule(
    id="run.start-failed",
    meaning="a process or node could not be started",
    fix="look at its `run` entry and at the last lines of its log",
    names_log=True,
)
TRANSITION_FAILED = Rule(
    id="run.transition-failed",
    meaning="a node refused or failed a transition",
    fix="look at the reason, and at the traceback in the node's log",
    names_log=True,
)
DEADLINE = Rule(
    id="run.deadline",
    meaning="a step, or the whole bring-up, took longer than it may",
    fix="see what it waited for; raise the node's `timeouts` or `--timeout` if it needs longer",
)
NOT_PROGRAMMED = Rule(
    id="run.not-programmed",
    meaning="a network could not be programmed with the verified flows",
    fix="see which privilege, program or server is missing; `flows apply --dry-run` tries it alone",
)
NOT_WIRED = Rule(
    id="run.not-wired",
    meaning="a connection or a mapping could not be made, or made again",
    fix="the message names node, connection, endpoint and the node's own reason",
)
SILENT_NODE = Rule(
    id="run.silent-node",
    meaning="a node was stopped, hangs in a callback, or cannot be reached any more",
    fix="the message says which; a callback that may take long needs a larger `timeouts.silent_s`",
    heals=Heals.WITH_TIME,
    about=About.PRESENCE,
)
NOT_ANSWERING = Rule(
    id="run.not-answering",
    meaning="a node that is in no host of ours answers no request",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="look at what its callbacks wait for, and whether its process was stopped",
    heals=Heals.WITH_TIME,
    about=About.PRESENCE,
)
PLANS_DIFFER = Rule(
    id="run.plans-differ",
    meaning="the supervisor of another machine planned another system than this one",
    fix="give both supervisors the same manifest and arguments, and start them again",
)
PLAN_UNKNOWN = Rule(
    id="run.plan-unknown",
    meaning="the supervisor of another machine does not say what it planned",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="run the same version of lifecycle on every machine of the system",
    heals=Heals.WITH_TIME,
)
RUN_RULES = (
    PROCESS_DIED,
    GAVE_UP,
    START_FAILED,
    TRANSITION_FAILED,
    DEADLINE,
    NOT_PROGRAMMED,
    NOT_WIRED,
    SILENT_NODE,
    NOT_ANSWERING,
    PLANS_DIFFER,
    PLAN_UNKNOWN,
)


def node_of(subject: str) -> str:
    """Return the node that a subject of these rules names; empty for a process or a system."""
    return subject if subject.startswith("/") else ""
