"""What shows a session to people: the page for a browser, and TensorBoard. Each is imported only if asked for."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING

from usvlearn.errors import ConfigError

if TYPE_CHECKING:
    from usvlearn.live.health import Health
    from usvlearn.live.live_board import Board
    from usvlearn.live.node import Step
    from usvlearn.live.start import Options
    from usvlearn.live.web_page import WebPage


class Displays:
    """The page and the board of a session, as far as its options ask for them."""

    def __init__(self, options: Options):
        if options.tensorboard is not None and importlib.util.find_spec("tensorboard") is None:
            raise ConfigError("tensorboard: it is not installed here: run `pip install tensorboard`, or leave it out")
        self._folder = options.tensorboard
        self._board: Board | None = None
        self._page: WebPage | None = None
        self.sentence, self.warnings = "", {"page": "", "board": ""}
        if options.page is not None:
            from usvlearn.live.web_page import WebPage

            self._page = WebPage(options.page)
            self.sentence, self.warnings["page"] = f"; page: {self._page.url}", self._page.warning

    def steps(self, steps: Sequence[Step]) -> None:
        """Take the steps that were made."""
        self._draw(steps)
        if self._page is not None:
            self._page.take(steps)

    def health(self, health: Health, step: Step | None, ready: bool = True) -> None:
        """Show the health, and the last step."""
        if ready:
            self._draw(health=health)
        if self._page is not None:
            self._page.show(health, step)

    def close(self) -> None:
        """Show no more."""
        self._draw(close=True)
        if self._page is not None:
            self._page.close()

    def _draw(self, steps: Sequence[Step] = (), health: Health | None = None, close: bool = False) -> None:
        """Show in TensorBoard; a full disk ends that, and nothing else."""
        if self._folder is None or self.warnings["board"]:
            return
        try:
            if self._board is None:
                from usvlearn.live.live_board import Board

                self._board = Board(self._folder)
            for step in steps:
                self._board.step(step)
            if health is not None:
                self._board.health(health)
            if close:
                self._board.close()
        except OSError as error:
            cause = error.strerror or error
            self.warnings["board"] = f"TensorBoard's files end here ({cause}): make room on the disk"
