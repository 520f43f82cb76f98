"""The page of a node: what it shows, who may read it, and that it loads nothing else."""

import http.client
import json
import shutil
import subprocess

import pytest

from tests.support.live import boat, messages, ready, sail
from usvlearn.errors import ConfigError
from usvlearn.live.health import COMPILING
from usvlearn.live.web_page import PAGE, WebPage, address_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def asked(page, path="/status", method="GET", host=None):
    """The answer to a request."""
    port = int(page.url.rstrip("/").rpartition(":")[2])
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    return answer, answer.read()


@pytest.fixture
def page():
    web = WebPage("0")
    yield web
    web.close()


def test_it_is_read_only_and_for_this_computer(page):
    page.show(COMPILING._replace(warnings=("<script>alert(1)</script>",)))
    answer, content = asked(page)
    assert answer.status == 200 and json.loads(content)["state"] == "compiling"
    answer, content = asked(page, "/")
    assert content.decode() == PAGE and "default-src 'none'" in answer.getheader("Content-Security-Policy")
    assert "http" not in PAGE.replace("<!doctype html>", "").replace("<html", "").replace("</html>", "")
    wrong = [("/../session.py", "GET", None, 404), ("/", "POST", None, 501), ("/status", "GET", "evil.example:80", 403)]
    for path, method, host, status in wrong:
        assert asked(page, path, method, host)[0].status == status
    assert not page.warning
    (port,) = (address_of(page.url.removeprefix("http://").rstrip("/"))[1],)
    with pytest.raises(ConfigError, match=r"page: 127\.0\.0\.1:\d+ cannot be served .*choose another port"):
        WebPage(str(port))


@pytest.mark.parametrize("text", ["", "port", "99999", "here:80", "127.0.0.1:", "-1", "１"])
def test_an_address_that_is_none_is_told(text):
    with pytest.raises(ConfigError, match=r"page: found .*expected a port, or IPv4:PORT, such as 8808"):
        WebPage(text)


def test_another_address_is_warned_about():
    web = WebPage("0.0.0.0:0")
    try:
        assert "can be read by everyone" in web.warning and asked(web, host="boat.local")[0].status == 200
    finally:
        web.close()


def test_it_shows_what_the_node_knows(tmp_path, start):
    with ready(tmp_path, start, page="0") as session:
        assert session._displays._page.url in session.sentence
        sail(session, list(messages(boat(0.02))))
        session.tick()
        content = json.loads(asked(session._displays._page)[1])
        assert content["now"][1:3] == [session.last.measured, session.last.speed] and len(content["history"]) > 50
        assert [each[0] for each in content["forecasts"]] == list(session.last.forecasts)
        url = session._displays._page.url
        if CHROMIUM is not None:
            command = [
                CHROMIUM,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--virtual-time-budget=4000",
                "--dump-dom",
                url,
            ]
            seen = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
            assert "steps" in seen and "no alarm (0 so far)" in seen and "connecting" not in seen
    with pytest.raises(OSError):
        asked(session._displays._page)
