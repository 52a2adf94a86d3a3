"""Which of the names that rmw_dds_common shows are of nodes that have left."""

from __future__ import annotations

from collections import Counter

from lifecycle.middleware.rcl.stale_node_filter import without_dead, without_ghosts

OLD, NEW, OTHER = "0" * 24, "1" * 24, "2" * 24


def test_a_node_that_came_again_beside_its_own_ghost_is_one() -> None:
    homes = {"/listener": Counter({NEW: 1})}
    before = {"/listener": frozenset({OLD, NEW})}
    assert without_ghosts({"/listener": 2}, homes, before, frozenset({NEW}), frozenset({NEW})) == {
        "/listener": 1
    }


def test_a_ghost_alone_is_nobody() -> None:
    homes = {"/talker": Counter({OTHER: 1})}
    before = {"/listener": frozenset({OLD})}
    shown = {"/listener": 1, "/talker": 1}
    assert without_ghosts(shown, homes, before, frozenset({OTHER}), frozenset({OTHER})) == {
        "/talker": 1
    }


def test_two_nodes_of_one_name_stay_two() -> None:
    before = {"/listener": frozenset({OLD, NEW, OTHER})}
    in_two_processes = {"/listener": Counter({NEW: 1, OTHER: 1})}
    alive = frozenset({NEW, OTHER})
    assert without_ghosts({"/listener": 3}, in_two_processes, before, alive, alive) == {
        "/listener": 2
    }
    in_one_process = {"/listener": Counter({NEW: 2})}
    alive = frozenset({NEW})
    assert without_ghosts({"/listener": 2}, in_one_process, before, alive, alive) == {
        "/listener": 2
    }


def test_a_second_node_whose_participant_never_was_another_is_no_ghost() -> None:
    homes = {"/listener": Counter({NEW: 1})}
    before = {"/listener": frozenset({NEW})}
    assert without_ghosts({"/listener": 2}, homes, before, frozenset({NEW}), frozenset({NEW})) == {
        "/listener": 2
    }


def test_nothing_is_a_ghost_while_somebodys_nodes_are_not_known() -> None:
    """The participant without a known node may be where the node is."""
    before = {"/listener": frozenset({OLD})}
    assert without_ghosts({"/listener": 1}, {}, before, frozenset({NEW}), frozenset()) == {
        "/listener": 1
    }


def test_a_node_that_is_still_where_it_was_is_never_taken_away() -> None:
    homes = {"/listener": Counter({NEW: 1}), "/talker": Counter({NEW: 1})}
    before = {"/listener": frozenset({OLD, NEW}), "/talker": frozenset({OTHER, NEW})}
    shown = {"/listener": 1, "/talker": 1}
    assert without_ghosts(shown, homes, before, frozenset({NEW}), frozenset({NEW})) == shown


def test_a_dead_node_is_nobody_although_discovery_shows_it() -> None:
    homes = {"/talker": Counter({OTHER: 1})}
    before = {"/listener": frozenset({OLD}), "/talker": frozenset({OTHER})}
    shown = {"/listener": 1, "/talker": 1}
    assert without_dead(shown, homes, before, frozenset({OLD})) == {"/talker": 1}


def test_the_node_that_came_again_beside_a_dead_one_is_one() -> None:
    before = {"/listener": frozenset({OLD, NEW})}
    dead = frozenset({OLD})
    homes = {"/listener": Counter({NEW: 1})}
    assert without_dead({"/listener": 2}, homes, before, dead) == {"/listener": 1}
    # Names and endpoints of the dead one go one after the other.
    assert without_dead({"/listener": 1}, homes, before, dead) == {"/listener": 1}
