"""The command certify, as it is called in this process."""

import json

from certify.__main__ import main


def told(capsys, *arguments) -> tuple[int, list]:
    """Its exit code and its JSON."""
    code = main([*map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)
