"""Aligns logs, checks the result, and prints the findings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console

from usvlearn.core.samples import Fleet
from usvlearn.core.unconfirmed import open_questions, unconfirmed
from usvlearn.display.terminal import show
from usvlearn.errors import LogFormatError
from usvlearn.logs.checks.data_check import CHECKS, check_data, check_level, refuse
from usvlearn.logs.checks.finding import Finding
from usvlearn.logs.recordings import align_fleet
from usvlearn.report.tables import data_check_table


class CheckedAlignment:
    """Aligns like `align_fleet`, checks the data, and shows each finding once; without a console nothing.

    With `check=strict` a warning is an error, with `check=off` nothing is checked. If nothing can be aligned, the error
    says what the check found. `findings` has those of all that was aligned; None if nothing was checked.
    """

    def __init__(self, settings: Mapping[str, Any], console: Console | None = None):
        self.findings: list[Finding] | None = None
        self._level = check_level(settings.get("check"))
        self._channels = (settings.get("data") or {}).get("channels") or {}
        self._surge_max = (settings.get("vehicle") or {}).get("surge_max") or math.inf
        self._horizons = (settings.get("forecasts") or {}).get("horizons") or ()
        self._console = console
        self._asked = unconfirmed(open_questions(settings))

    def __call__(self, recordings: Iterable, **options: Any) -> Fleet:
        """The fleet; `usvlearn.logs.recordings.align_fleet` has the arguments and errors."""
        if self._level == "off":
            return align_fleet(recordings, **options)
        recordings = list(recordings)
        try:
            fleet = align_fleet(recordings, **options)
        except LogFormatError as error:
            raise self._explained(error, recordings, options) from error
        findings = check_data(recordings, fleet, options, self._surge_max, self._channels, self._horizons)
        if self._level == "strict":
            refuse(findings)
        new = [each for each in findings if each not in (self.findings or ())]
        if self._console is not None and (new or self.findings is None):
            self._console.print(data_check_table([each._asdict() for each in new], len(CHECKS)))
            show(*[f"{each}\n" for each in self._asked if self.findings is None], to=self._console)
        self.findings = [*(self.findings or []), *new]
        return fleet

    def _explained(self, error: LogFormatError, recordings: list, options: Mapping[str, Any]) -> LogFormatError:
        """The error of an alignment, with what the check finds in the recordings."""
        findings = check_data(recordings, None, options, self._surge_max, self._channels)
        sentences = "; ".join(each.sentence() for each in findings)
        return LogFormatError(f"{error}; data check: {sentences}") if sentences else error

    @property
    def json(self) -> list[dict[str, str]] | None:
        """The findings as `results.json` has them; None if nothing was checked."""
        return None if self.findings is None else [each._asdict() for each in self.findings]
