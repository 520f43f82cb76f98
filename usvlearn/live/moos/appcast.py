"""AppCasts: the page of an app that a MOOS viewer asks for and shows."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator

FIELD, ITEM = "!@#", "!@"  # what separates fields, and items of a field
PERIOD = 0.4  # s between two AppCasts, at least
LONGEST = 30.0  # s, for which one request counts, at most
KEYS = 100  # viewers and warnings that are remembered
EVENTS = 8  # that are shown


class AppCasts:
    """Who has asked for AppCasts, and what they are told.

    Args:
        app: name of this app.

    Attributes:
        warnings: run warning -> how often it came.

    >>> casts = AppCasts("pUSVLearn")
    >>> casts.ask("node=all,app=all,duration=3.0,key=viewer,thresh=any", 10.0, "usv")
    >>> casts.due(11.0), casts.due(11.1), casts.due(12.0), casts.due(13.5)
    (True, False, True, False)
    """

    def __init__(self, app: str):
        self.app = app
        self.warnings: Counter[str] = Counter()
        self.config_warnings: list[str] = []
        self._asked: dict[str, tuple[float, bool]] = {}  # key -> until when, and whether only warnings are wanted
        self._events: deque[str] = deque(maxlen=EVENTS)
        self._total = 0
        self._cast = float("-inf")
        self._told_warnings = 0  # run warnings at the last AppCast

    def ask(self, text: str, clock: float, node: str) -> None:
        """Take an `APPCAST_REQ`; anything else is ignored.

        Args:
            text: of the request.
            clock: monotonic time, s.
            node: community of this app.
        """
        given: dict[str, str] = {}
        for part in text.split(","):
            name, _, value = part.strip().partition("=")
            given[name] = value
        try:
            duration = float(given.get("duration", "0"))
        except ValueError:
            return
        if given.get("node") not in (node, "all") or given.get("app") not in (self.app, "all") or not duration > 0:
            return
        key = given.get("key", "")[:100]
        self._asked.pop(key, None)  # so that the newest is the last
        self._asked[key] = clock + min(duration, LONGEST), given.get("thresh") == "run_warning"
        while len(self._asked) > KEYS:
            del self._asked[next(iter(self._asked))]

    def due(self, clock: float) -> bool:
        """Whether an AppCast is due now, which it then is not for a while."""
        self._asked = {key: each for key, each in self._asked.items() if each[0] >= clock}
        new_warnings = self.warnings.total() > self._told_warnings
        if clock - self._cast < PERIOD or not any(new_warnings or not only for _, only in self._asked.values()):
            return False
        self._cast, self._told_warnings = clock, self.warnings.total()
        return True

    def warn(self, text: str) -> None:
        """Add a run warning, or count it once more."""
        self.warnings[text] += 1
        while len(self.warnings) > KEYS:
            del self.warnings[next(iter(self.warnings))]

    def event(self, text: str, uptime: float) -> None:
        """Add an event, which is shown with the time since the start, s."""
        self._total += 1
        self._events.append(f"[{uptime:.2f}]: {text}")

    def compose(self, iteration: int, node: str, lines: Iterable[str]) -> str:
        """The text of an AppCast.

        Args:
            iteration: of the app.
            node: community of this app.
            lines: its page.
        """
        fields = {
            "proc": self.app, "iter": f"{iteration}", "node": node,
            "messages": "".join(f"{line}{ITEM}" for line in _plain(lines)),
            "config_warnings": ITEM.join(_plain(self.config_warnings)),
            "events_total": f"{self._total}", "events": ITEM.join(_plain(self._events)),
            "run_warning_total": f"{self.warnings.total()}",
            "run_warnings": ITEM.join(_plain(f"{count}:{text}" for text, count in self.warnings.most_common(EVENTS))),
        }  # fmt: skip
        return FIELD.join(f"{key}={text}" if text else "" for key, text in fields.items())


def _plain(lines: Iterable[str]) -> Iterator[str]:
    """Lines without what would separate them."""
    for line in lines:
        yield line.replace(ITEM, "! @").replace("\n", " ")
