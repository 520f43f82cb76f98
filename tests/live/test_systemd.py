"""The systemd unit that the documentation shows."""

import shutil
import subprocess

import pytest

from tests.support import ROOT


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    page = (ROOT / "docs" / "live" / "node.md").read_text()
    unit = page[page.index("[Unit]") :].partition("```")[0].replace("/home/boat/aboard/bin/usvlearn", "/bin/true")
    path = tmp_path / "usvlearn.service"
    for text, known in ((unit, True), (unit.replace("ProtectSystem=strict", "NoSuchKey=1"), False)):
        path.write_text(text)
        done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, timeout=60)
        own = [line for line in (done.stdout + done.stderr).splitlines() if "usvlearn.service" in line]
        assert (own == []) == known, own
