"""Orders: which fit what the system is doing, what each is in the state, and when it is done.

One is carried out at a time; one that comes meanwhile waits for its end. Each is answered once.
Pure.
"""

from __future__ import annotations

from lifecycle.errors import ExitCode, did_you_mean
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import advance
from lifecycle.supervisor.core.change import apply, enter_mode
from lifecycle.supervisor.core.passing import reached
from lifecycle.supervisor.core.state import Level, Node, Order, Passage, Run
from lifecycle.supervisor.run.events import Event

SAID = {
    ControlRequest.MODE: "switch the mode of",
    ControlRequest.APPLY: "apply another manifest to",
}

_UP = ("active", "paused", "held")
_ONLY_UP = "only a system that is active or paused can"
FITS = {
    ControlRequest.PAUSE: (("active", "held"), "only an active system can be paused"),
    ControlRequest.RESUME: (("paused", "held"), "only a paused system can be resumed"),
    ControlRequest.RESTART: (_UP, f"{_ONLY_UP} be restarted"),
    ControlRequest.MODE: (_UP, f"{_ONLY_UP} enter another mode"),
    ControlRequest.APPLY: (_UP, f"{_ONLY_UP} take another manifest"),
}
"""In which phases an order can begin, and what is said in any other."""

STARTS = (ControlRequest.RESTART, ControlRequest.APPLY)
"""Orders that start processes."""


def settled_phase(run: Run) -> str:
    """Return the phase without what policy does meanwhile, which is nobody's order."""
    if run.held_s is None or run.ending is not None or run.change is not None:
        return advance.phase_of(run)
    return advance.rests_as(run)


def refusal(run: Run, order: Order) -> str:
    """Return why an order cannot be carried out now; empty if it can."""
    phases, hint = FITS[order.ask]
    phase = settled_phase(run)
    if phase not in phases:
        return f"{_cannot(order, run.plan.system)}: it is {phase}; {hint}"
    return _unfit(run, order)


def _cannot(order: Order, what: str) -> str:
    return f"cannot {SAID.get(order.ask, order.ask.value)} {what!r}"


def _unfit(run: Run, order: Order) -> str:
    """Say why an order can be carried out in no phase; empty if it can."""
    if order.first is not None and order.first is not run.first:
        what = _cannot(order, run.plan.system)
        return f"{what}: another manifest was applied meanwhile; ask again"
    if order.ask in STARTS and run.broken:
        what = _cannot(order, order.node or run.plan.system)
        return (
            f"{what}: the discovery server has died, and without it nobody who comes again is "
            "found; start the system again: lifecycle down, then lifecycle up"
        )
    if order.node and named(run, order.node) is None:
        return _not_restarted(run, order.node)
    return _not_entered(run, order.mode) if order.ask is ControlRequest.MODE else ""


def _not_restarted(run: Run, name: str) -> str:
    """Say why a node is none that can be restarted."""
    known = run.nodes.get(name) or run.node_named(name)
    if known is not None:
        return f"cannot restart {known.name!r}: it is attached, no process of this supervisor"
    ours = sorted(each.name for each in run.nodes.values() if run.process_of(each) is not None)
    return f"cannot restart {name!r}: this supervisor runs no such node; it runs: {', '.join(ours)}"


def _not_entered(run: Run, mode: str) -> str:
    """Say why a mode cannot be entered; empty if it can."""
    system, modes = run.plan.system, [each.name for each in run.plan.modes]
    if mode not in modes:
        known = f"the modes {', '.join(modes)}" if modes else "no modes"
        hint = did_you_mean(mode, modes) if modes else "declare them under 'modes:'"
        text = f"cannot enter mode {mode!r} of {system!r}: it has {known}"
        return f"{text}; {hint}" if hint else text
    if run.elsewhere:
        return (
            f"cannot switch the mode of {system!r}: nodes on other machines run in it, too; modes "
            "are switched where one supervisor runs all nodes"
        )
    return ""


def named(run: Run, name: str) -> Node | None:
    """Return the node that an order names, if it is ours to restart."""
    node = run.nodes.get(name) or run.node_named(name)
    ours = node is not None and (node.planned.run.component or run.process_of(node) is not None)
    return node if ours else None


def take_order(run: Run, order: Order) -> list[Event]:
    """Take an order: it is refused at once, carried out, or waits for the one under way."""
    code, why = refused_at_once(run, order)
    if why:
        run.outbox = [*run.outbox, (order.id, code, why)]
    else:
        run.orders.append(order)
    return []


def refused_at_once(run: Run, order: Order) -> tuple[ExitCode, str]:
    """Return why an order is not even kept until its turn comes; an empty text if it is."""
    if run.ending is not None:
        text = f"cannot go on: {run.plan.system!r} is being taken down"
        return ExitCode.BRING_UP_FAILED, text
    if run.order is not None and run.order.ask is ControlRequest.APPLY:
        return ExitCode.USAGE, (
            f"{_cannot(order, run.plan.system)}: it is {advance.phase_of(run)}, another manifest "
            "is being applied to it; ask again once 'lifecycle apply' has ended; 'lifecycle down' "
            "is taken at once"
        )
    return ExitCode.USAGE, refusal(run, order) if run.held_s is None else _unfit(run, order)


def settle_orders(run: Run) -> list[Event]:
    """Be done with the order that is carried out, and begin the next."""
    events: list[Event] = []
    if run.pauses and _is_done(run):
        run.pauses = False
        events.append(reached(run, "paused"))
    if run.order is not None and _is_done(run):
        run.answer(ExitCode.OK)
    while run.order is None and run.orders and _is_free(run):
        order = run.orders.popleft()
        if why := refusal(run, order):
            run.outbox = [*run.outbox, (order.id, ExitCode.USAGE, why)]
            continue
        run.order = order
        events += _begin(run, order)
    return events


def _is_free(run: Run) -> bool:
    """Return whether nothing else is under way that an order would have to wait for."""
    busy = run.switch or run.change or run.asked or run.failures
    return not busy and advance.is_settled_down(run)


def _is_done(run: Run) -> bool:
    return _is_free(run) and run.opening is None


def _begin(run: Run, order: Order) -> list[Event]:
    """Note an order in the state, by which it is carried out."""
    if order.ask is ControlRequest.APPLY:
        return apply(run, order)
    run.passage = None
    if order.ask is ControlRequest.PAUSE:
        run.paused = run.pauses = True
    elif order.ask is ControlRequest.MODE:
        return enter_mode(run, order.mode)
    else:
        if order.ask is ControlRequest.RESTART:
            _restart(run, order)
            run.pauses = run.paused
        opens = order.ask is ControlRequest.RESUME or not run.paused
        until_s = run.now_s + run.timeout_s
        run.passage = Passage(until_s=until_s, activates=opens, judges=opens)
    run.changed()
    return []


def restarted(run: Run, order: Order) -> set[str]:
    """Return the keys of the nodes that an order restarts: of all that comes and goes with one."""
    if not order.node:
        return set(run.nodes)
    node = named(run, order.node)
    keys = set() if node is None else set(run.whole({node.key}))
    return keys | _gone_with(run, keys)


def _restart(run: Run, order: Order) -> None:
    """Have nodes go down once; failures are forgotten."""
    keys = restarted(run, order)
    names = {run.nodes[key].process for key in keys}
    run.deaths = [each for each in run.deaths if each.process not in names]
    for key in keys:
        each = run.nodes[key]
        each.due_s = 0.0
        each.renew = each.level > Level.DOWN or bool(each.process)
        process = run.processes.get(each.process)
        if process is not None:
            process.restarted_by_hand()


def _gone_with(run: Run, keys: set[str]) -> set[str]:
    """Return the keys of the nodes that wait in the same backoff, and for no failure of theirs."""
    names = {run.nodes[key].process for key in keys}
    found = set[str]()
    for name in names:
        process = run.processes.get(name)
        if process is not None and process.failed:
            found.update(run.group(name))
    others = {each.name for each in run.processes.values() if each.failed} - names
    return {key for key in found if run.nodes[key].process not in others}
