"""The error that certify raises for bad input: each message says what was found, where, what was expected, the fix."""


class CertifyError(ValueError):
    """Bad input that the user can fix. `python -m certify` prints it in one sentence and exits with code 2."""


def quoted(value: object) -> str:
    """At most 80 characters of a value, for a message: a value from a file can have any length.

    >>> quoted("tight"), len(quoted("x" * 1000))
    ("'tight'", 80)
    """
    return shortened(repr(value))


def shortened(text: object) -> str:
    """At most 80 characters of a text, in one line.

    >>> shortened("no such\\n file")
    'no such file'
    """
    line = " ".join(str(text).split())
    return line if len(line) <= 80 else f"{line[:79]}…"
