"""The error that certify raises at its borders: each message says what, where, expected and what to do."""


class CertifyError(ValueError):
    """Bad input that a person can mend. `python -m certify` prints it in one sentence and exits with code 2."""
