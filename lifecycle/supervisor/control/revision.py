"""Whether a manifest is still the one that runs, and whether a running system can take a new one.

Owns: `Revisions`: an order that comes with a plan is refused where that plan is not the one that
runs, unless it says to reload it; and what cannot be reloaded while the supervisor runs, with the
reason. What differs is `plan.comparison`'s to say. Must not import rclpy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Iterator

from lifecycle.codec import to_plain
from lifecycle.errors import UsageError
from lifecycle.manifest.model import DataLayerSource
from lifecycle.plan import Change, Plan, PlannedNode, changes, with_files_of_now
from lifecycle.supervisor.control.orders import Order, OrderKind, node_of
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.options import UpOptions, local_processes

_MOST = 20
_RELOADED = ("nodes.", "links.", "policy.")
"""Parts of a manifest that a running supervisor can take anew: the rest made the supervisor's own
participant, its authority and the networks that it programs."""


class Revisions:
    """The manifest of one running system."""

    def __init__(self, system: System, options: UpOptions) -> None:
        self._system = system
        self._options = options

    def differences(self, plan: Plan) -> tuple[str, ...]:
        """Say how `plan` differs from what runs, one line each; empty if it does not."""
        return _lines(changes(self._system.first, plan))

    def takes(self, order: Order) -> bool:
        """Whether an order brings a plan that is to replace the one that runs."""
        return (
            order.reload
            and order.plan is not None
            and bool(changes(self._system.first, order.plan))
        )

    def check(self, order: Order) -> None:
        """Make sure that nothing but the manifest that the order means comes to run.

        Raises:
            UsageError: the manifest has changed since the start, or cannot be reloaded.
        """
        running = self._system.first
        if order.plan is not None:
            found = changes(running, order.plan)
            if found and order.reload:
                self._check_reload(order, order.plan, found)
            elif found and order.kind is not OrderKind.PAUSE:
                raise self._refused(order, found)
        elif order.kind is OrderKind.RESTART:
            keys = self._restarted(order)
            found = changes(running, with_files_of_now(running))
            if found := tuple(each for each in found if each.node in keys):
                raise self._refused(order, found)

    def _restarted(self, order: Order) -> Collection[str]:
        """Return the keys of all nodes that an order restarts."""
        if not order.node:
            return tuple(self._system.nodes)
        process = node_of(order, self._system).process
        assert process is not None
        return process.planned.nodes

    def _refused(self, order: Order, found: Iterable[Change]) -> UsageError:
        system = self._system.plan.system
        what = order.kind.value
        listed = "\n".join(_lines(found))
        path = (order.plan or self._system.first).manifest_path
        take = f"lifecycle restart {path} --reload"
        same = f"; or keep what runs: lifecycle {what} {system}" if order.plan is not None else ""
        return UsageError(
            f"cannot {what} {system!r}: its manifest is not the one that runs:\n{listed}\n"
            f"take the new one: {take}{same}"
        )

    def _check_reload(self, order: Order, plan: Plan, found: tuple[Change, ...]) -> None:
        system, running = self._system, self._system.first

        def refuse(why: str, lines: Iterable[str] = ()) -> UsageError:
            listed = "".join(f"\n{each}" for each in lines)
            return UsageError(
                f"cannot reload the manifest of {running.system!r} while it runs: {why}{listed}",
                hint="end it and start it anew: lifecycle down, then lifecycle up",
            )

        fixed = [each for each in found if not f"{each.path}.".startswith(_RELOADED)]
        if fixed:
            raise refuse("a running supervisor cannot change this:", _lines(fixed))
        if (running.observers, running.server) != (plan.observers, plan.server):
            raise refuse("its supervisor would be connected otherwise")
        if system.remote or len(local_processes(plan, self._options.machine)) < len(plan.processes):
            raise refuse("nodes on other machines run by it, too:", _lines(found))
        if running.data_layer.source is DataLayerSource.DYNAMIC:
            raise refuse("its data layer is negotiated by the manifest that runs")
        if self._options.program:
            raise refuse("networks are programmed by the manifest that runs")
        if any(url.startswith("tcpv4:") for each in (running, plan) for url in _urls(each)):
            raise refuse("a TCP port that was used is not connected to again by who used it")
        if order.node:
            self._check_node(order, plan, found)

    def _check_node(self, order: Order, plan: Plan, found: tuple[Change, ...]) -> None:
        """Make sure that only the nodes that restart are to change."""
        running = self._system.first
        keys = self._restarted(order)
        whole = f"restart the whole system: lifecycle restart {plan.manifest_path} --reload"
        others = [each for each in found if each.node not in keys]
        if others:
            listed = "\n".join(_lines(others))
            raise UsageError(
                f"cannot reload {order.node!r} alone: more has changed:\n{listed}\n{whole}"
            )
        processes = {each.name: each.nodes for each in plan.processes}
        name = running.node(keys[0]).process if isinstance(keys, tuple) else ""
        if processes.get(name) != tuple(keys):
            raise UsageError(
                f"cannot reload {order.node!r} alone: it would run in another process", hint=whole
            )
        for node in plan.nodes:
            if node.key not in keys and _bare(node) != _bare(running.node(node.key)):
                raise UsageError(
                    f"cannot reload {order.node!r} alone: {node.full_name!r} would be connected "
                    "otherwise",
                    hint=whole,
                )


def _lines(found: Iterable[Change]) -> tuple[str, ...]:
    """Word differences with their places in the new manifest, at most 20 of them."""
    every = tuple(found)
    lines = []
    for each in every[:_MOST]:
        place = f"{each.at.file}:{each.at.line}:{each.at.column}: " if each.at else ""
        lines.append(f"{place}{each.path}: was {each.old}, is {each.new}")
    if len(every) > _MOST:
        lines.append(f"and {len(every) - _MOST} more")
    return tuple(lines)


def _urls(plan: Plan) -> Iterator[str]:
    for _, connections in plan.observers:
        yield from connections.urls
    for node in plan.nodes:
        yield from node.connections.urls
        for each in node.participants:
            yield from each.connections.urls


def _bare(node: PlannedNode) -> object:
    """Return a planned node without positions."""

    def bare(value: object) -> object:
        if isinstance(value, dict):
            return {key: bare(each) for key, each in value.items() if key != "at"}
        if isinstance(value, list):
            return [bare(each) for each in value]
        return value

    return bare(to_plain(dataclasses.replace(node, files=())))
