"""The argument by which train.py takes a configuration, as Hydra and a POSIX shell read it."""

from __future__ import annotations

import re
import shlex

PLAIN = re.compile(r"[\w/.:-]+", re.ASCII)  # what Hydra takes without quotes
SPECIAL = set('"$`\\!')  # to a shell, within double quotes


def hydra_text(value: str) -> str:
    r"""A value of an override, quoted if need be."""
    if PLAIN.fullmatch(value):
        return value
    return "'{}'".format(re.sub(r"(\\*)'", r"\1\1\\'", value))  # Hydra halves backslashes before a quote only


def shell_override(path: str) -> str:
    """`data=PATH` for a command line."""
    text = f"data={hydra_text(path)}"
    return f'"{text}"' if "'" in text and not SPECIAL & set(text) else shlex.quote(text)
