"""Node configurations as parties of a negotiation.

Owns: `party_of`: what a node says of itself, under what its manifest says of it. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

from lifecycle.manifest.model import EndpointKind
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.connections.contacts import contacts_of
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.negotiation.data_layer import RMW_DEFAULT, TRANSPORTS, Party, PartyEndpoint
from lifecycle.plan.negotiation.parties import FAST_DDS, endpoint_of, transports_of
from lifecycle.verify.observation import ConnectionReport, EndpointReport, NodeConfiguration

_OWN_FLOW = (UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED)


def party_of(
    configuration: NodeConfiguration,
    host: str,
    *,
    planned: PlannedNode | None = None,
    negotiated: Collection[str] = (),
) -> Party:
    """Return a node as a party, from what it says of itself.

    What `planned` asks for an endpoint wins over the node's own hints. Endpoints that were made in
    code take part under their resolved names.

    Args:
        configuration: as the node reports it.
        host: its host, see `lifecycle.plan.connections.hosts`.
        planned: the node as the manifest declares it; None if it does not.
        negotiated: names of connections that a negotiation made before: it may unmake them. Others
            are somebody else's, and what is mapped onto them stays there.
    """
    known = configuration.rmw.startswith(FAST_DDS)
    own_urls = planned.connections.urls if planned else ()
    own = next((each for each in configuration.connections if not each.name), None)
    if own is not None and own.urls:
        own_urls = own.urls
    default = (planned.transports if planned else ()) or RMW_DEFAULT
    others = [
        each for each in configuration.connections if each.name and each.name not in {*negotiated}
    ]
    taken = {each.name for each in others}
    if planned is not None:
        taken |= {each.connection for each in planned.participants if each.connection}
    return Party(
        key=planned.key if planned else configuration.name,
        full_name=configuration.name,
        host=host,
        process=str(configuration.identity.process_id),
        transports=(configuration.transports or TRANSPORTS) if known else (),
        own=(transports_of(own_urls) or default) if known else (),
        connectable=known,
        serializations=configuration.serializations,
        paradigms=configuration.paradigms,
        endpoints=tuple(
            _endpoint(each, planned, others)
            for each in configuration.endpoints
            if each.kind.is_topic
        ),
        connections=tuple(sorted(taken)),
        contacts=contacts_of(host, own_urls),
    )


def _endpoint(
    report: EndpointReport, planned: PlannedNode | None, others: Collection[ConnectionReport]
) -> PartyEndpoint:
    declared = next(
        (
            each
            for each in (planned.endpoints if planned else ())
            if (each.kind, each.name) == (report.kind, report.name)
        ),
        None,
    )
    carrier = next((each for each in others if each.name == report.connection), None)
    if declared is not None and planned is not None:
        endpoint = endpoint_of(planned, declared)
        endpoint = dataclasses.replace(
            endpoint,
            resolved=report.resolved or endpoint.resolved,
            lossy=report.lossy if endpoint.lossy is None else endpoint.lossy,
            size_bytes=report.size_bytes if endpoint.size_bytes is None else endpoint.size_bytes,
        )
    else:
        endpoint = PartyEndpoint(
            kind=report.kind,
            name=report.name or report.resolved,
            resolved=report.resolved,
            type=report.type,
            qos=report.qos,
            alone=report.kind is EndpointKind.PUBLISHER and report.unique in _OWN_FLOW,
            lossy=report.lossy,
            size_bytes=report.size_bytes,
        )
    if carrier is None:
        return endpoint
    return dataclasses.replace(endpoint, by=transports_of(carrier.urls) or RMW_DEFAULT, fixed=True)
