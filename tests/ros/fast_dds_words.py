"""What a program wrote to standard error beside the words of Fast DDS: `without_fast_dds`."""

from __future__ import annotations

import re

_TRANSPORT = re.compile(r"\[RTPS_TRANSPORT_SHM.*Error\].*init_port")


def without_fast_dds(errors: str) -> list[str]:
    """Return the lines but those of a port of shared memory that another process has just taken.

    Fast DDS then takes the next one. Ports 7000–7399, for the reader of every participant's graph,
    are tried by processes of all domains, so this may happen at any time.
    """
    plain = re.sub(r"\x1b\[[0-9;]*m", "", errors)
    return [line for line in plain.splitlines() if not _TRANSPORT.search(line)]
