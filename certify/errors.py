"""The error that certify raises at its borders: each message says what, where, expected and what to do."""


class CertifyError(ValueError):
    """Bad input that a person can fix. `python -m certify` prints it in one sentence and exits with code 2."""


def quoted(value: object) -> str:
    """At most 80 characters of a value, for a message: what a file holds can be of any length.

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
