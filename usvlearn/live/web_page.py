"""A page that shows what a node does, in a browser: it can be read only, and by default on this computer alone."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import threading
from collections import deque
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from usvlearn.display.json_values import finite
from usvlearn.errors import ConfigError
from usvlearn.live.health import Health
from usvlearn.live.node import Step

HOST, PORT = "127.0.0.1", "8808"
HISTORY = 600  # steps that are drawn, at most
PAGE = Path(__file__).with_name("web_page.html").read_text(encoding="utf-8")
SCRIPT = PAGE.partition("<script>")[2].partition("</script>")[0]
POLICY = (  # of what the page may load: nothing but its own script, and its own numbers
    f"default-src 'none'; script-src 'sha256-{base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()}'; "
    "style-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def address_of(text: str) -> tuple[str, int]:
    """Host and port of PORT or HOST:PORT."""
    host, colon, port = text.strip().rpartition(":")
    host = host.strip("[]") if colon else HOST
    try:
        if port.isascii() and port.isdigit() and int(port) < 65536:
            return str(ip_address("127.0.0.1" if host == "localhost" else host)), int(port)
    except ValueError:
        pass
    raise ConfigError(f"page: found {text!r}, expected a port, or IPv4:PORT, such as {PORT} or 0.0.0.0:{PORT}")


class WebPage:
    """Serves the page in a thread; each request gets what `show` was given last. Port 0 takes a free one."""

    def __init__(self, address: str):
        host, port = address_of(address)
        self.open = not ip_address(host).is_loopback
        self._told, self._history = b"{}", deque[tuple[float, ...]](maxlen=HISTORY)
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 10  # s, after which a client that says nothing is left

            def do_GET(self) -> None:
                if not page.open and self.headers.get("Host", "").rpartition(":")[0] not in (HOST, "localhost"):
                    self.send_error(403)  # another site's name that leads here
                elif self.path == "/":
                    self._send(PAGE.encode(), "text/html; charset=utf-8")
                elif self.path == "/status":
                    self._send(page._told, "application/json")
                else:
                    self.send_error(404)

            def _send(self, content: bytes, kind: str) -> None:
                self.send_response(200)
                for name, value in (("Content-Type", kind), ("Content-Length", str(len(content))),
                                    ("Content-Security-Policy", POLICY), ("Cache-Control", "no-store"),
                                    ("X-Content-Type-Options", "nosniff")):  # fmt: skip
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_: Any) -> None:  # a browser that has gone
                pass

        try:
            self._server = Server((host, port), Handler)
        except OSError as error:
            cause = error.strerror or error
            raise ConfigError(f"page: {host}:{port} cannot be served ({cause}): choose another port") from error
        self.url = f"http://{host}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, name="usvlearn-page", daemon=True).start()

    @property
    def warning(self) -> str:
        """A sentence where others can read it, else ""."""
        return f"the page {self.url} can be read by everyone in the network" if self.open else ""

    def take(self, steps: Sequence[Step]) -> None:
        """Keep steps for the curves."""
        self._history.extend((step.time, step.measured, step.speed, step.low, step.high) for step in steps)

    def show(self, health: Health, step: Step | None = None) -> None:
        """Tell this from now on."""
        ahead: dict[str, Any] = {}
        if step is not None:
            ahead = {
                "forecasts": [(horizon, *ends) for horizon, ends in step.forecasts.items()],
                "places": [(horizon, *point) for horizon, point in step.places.items()],
                "now": (step.time, step.measured, step.speed, step.low, step.high),
            }
        content = {
            "state": health.state, "sentence": health.sentence, "alarm": health.loss, "alarms": health.alarms,
            "saved": health.saved, "uptime": health.uptime, "warnings": health.warnings, "notes": health.notes,
            "quantities": {name: each for name, each in health.known.items() if math.isfinite(each[0])},
            "history": list(self._history), **ahead,
        }  # fmt: skip
        self._told = json.dumps(finite(content)).encode()

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()
