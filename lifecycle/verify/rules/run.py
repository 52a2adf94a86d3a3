"""Rules about the run itself: what a supervisor finds while it brings a system up and holds it.

Nothing here can be seen in an observation: the supervisor makes these findings and puts them into
the run's last verdict, so that it names what went wrong. Pure.
"""

from __future__ import annotations

from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule

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
RULES = (
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
