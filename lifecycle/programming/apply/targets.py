"""Creates network targets (nftables, tc, NEF, CAMARA) from options or from a ledger.

Owns: which targets there are and what each needs. A ledger's record has to be enough to remove what
it lists, long after the options are forgotten.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.programming.apply import camara, nef, nft, tc
from lifecycle.programming.apply.changes import Target
from lifecycle.programming.apply.errors import SettingsError
from lifecycle.programming.apply.http import Api, Clock, Patience
from lifecycle.programming.apply.ledger import Ledger, TargetRecord
from lifecycle.programming.apply.remote import RemoteTarget
from lifecycle.programming.apply.settings import (
    CamaraTargetSettings,
    NefTargetSettings,
    Settings,
    load_settings,
)
from lifecycle.programming.apply.tool import Deadline, Tool
from lifecycle.programming.rules.tc import DEFAULT_QUEUE_MS, TcMatch, TcSettings

KINDS = (nft.KIND, tc.KIND, nef.KIND, camara.KIND)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TargetOptions:
    """The options of one target.

    Attributes:
        kind: of KINDS.
        device: network device, tc only.
        link_kbit: rate of the link behind it, kbit/s; None for strict priority without rates.
        guaranteed_kbit: rates by class name, kbit/s; tc with a rate only.
        match: what tc's filters look at.
        queue_ms: how long the queue of each class may become, milliseconds at the link's rate;
            None for tc_settings.DEFAULT_QUEUE_MS.
        settings: path of the settings file; nef and camara only.
    """

    kind: str
    device: str = ""
    link_kbit: int | None = None
    guaranteed_kbit: Mapping[str, int] = dataclasses.field(default_factory=dict)
    match: TcMatch = TcMatch.FLOW
    queue_ms: float | None = None
    settings: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"cannot program target {self.kind!r}; use {', '.join(KINDS)}")
        if self.kind == tc.KIND and not self.device:
            raise UsageError(
                "cannot program tc without a device; only devices that are named are touched",
                hint="give --device eth0",
            )
        if self.kind in (nef.KIND, camara.KIND) and not self.settings:
            raise UsageError(
                f"cannot program {self.kind} without settings: where it is and who we are",
                hint="give --config FILE",
            )

    def tc(self) -> TcSettings:
        """Return the settings for tc.

        Raises:
            UsageError: the options do not fit together.
        """
        try:
            return TcSettings(
                device=self.device,
                link_kbit=self.link_kbit,
                guaranteed_kbit=self.guaranteed_kbit,
                match=self.match,
                queue_ms=DEFAULT_QUEUE_MS if self.queue_ms is None else self.queue_ms,
            )
        except ValueError as error:
            raise UsageError(str(error)) from error


class Targets:
    """Makes targets and closes what they hold.

    Args:
        ledger: of the system.
        tool: runs nft and tc; None for this host.
        patience: with servers.
        clock: for servers.

    Attributes:
        deadline: of everything that the targets ask of servers.
    """

    def __init__(
        self,
        ledger: Ledger,
        *,
        tool: Tool | None = None,
        patience: Patience | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.ledger = ledger
        self.deadline = Deadline()
        self._tool = tool
        self._patience = patience
        self._clock = clock
        self._open: list[Api] = []

    def make(self, options: TargetOptions) -> Target:
        """Return the target that a person asked for.

        Raises:
            UsageError: the options do not fit.
            SettingsError: the settings file cannot be used.
        """
        if options.kind == nft.KIND:
            return self._nft()
        if options.kind == tc.KIND:
            return tc.TcTarget(self.ledger.system, options.tc(), self.ledger, self._tool)
        return self._remote(options.kind, load_settings(options.settings))

    def restore(self, record: TargetRecord) -> Target:
        """Return the target that a ledger's record is of, good enough to remove what it lists.

        Raises:
            SettingsError: the settings file is gone, or is of another server now.
        """
        if record.target == nft.KIND:
            return self._nft()
        if record.target == tc.KIND:
            device = TcSettings(device=record.scope)
            return tc.TcTarget(self.ledger.system, device, self.ledger, self._tool)
        settings = load_settings(record.settings)
        scope = ""
        if record.target == nef.KIND and settings.nef is not None:
            scope = nef.nef_scope(settings.nef)
        elif record.target == camara.KIND and settings.camara is not None:
            scope = settings.camara.url.rstrip("/")
        if scope != record.scope:
            raise SettingsError(
                f"cannot remove what is at {record.scope}: settings {record.settings!r} are "
                f"{f'of {scope}' if scope else f'without {record.target}'} now"
            )
        return self._remote(record.target, settings)

    def close(self) -> None:
        """Close every connection."""
        for each in self._open:
            each.close()
        self._open.clear()

    def _nft(self) -> Target:
        try:
            return nft.NftTarget(self.ledger.system, self.ledger, self._tool)
        except ValueError as error:
            raise UsageError(str(error)) from error

    def _remote(self, kind: str, settings: Settings) -> Target:
        if kind == nef.KIND and settings.nef is not None:
            api = self._api(nef.nef_scope(settings.nef), settings.nef, settings.path)
            return RemoteTarget(nef.NefService(settings.nef, api), self.ledger, settings.path)
        if kind == camara.KIND and settings.camara is not None:
            api = self._api(settings.camara.url, settings.camara, settings.path)
            service = camara.CamaraService(settings.camara, api)
            return RemoteTarget(service, self.ledger, settings.path)
        raise SettingsError(
            f"cannot program {kind}: settings {settings.path!r} have no key {kind!r}"
        )

    def _api(self, url: str, settings: NefTargetSettings | CamaraTargetSettings, path: str) -> Api:
        ca_file = settings.ca_file and str(Path(path).parent / settings.ca_file)
        api = Api(
            url,
            token=settings.token,
            timeout_s=settings.timeout_s,
            ca_file=ca_file,
            patience=self._patience,
            clock=self._clock,
            deadline=self.deadline,
        )
        self._open.append(api)
        return api
