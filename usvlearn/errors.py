"""The errors that usvlearn raises at its borders: each message says what, where, expected and what to do."""


class UsvlearnError(ValueError):
    """Any bad input that a person can mend. `train.py` prints it in one sentence and exits with code 2."""


class LogFormatError(UsvlearnError):
    """A log that cannot be read as it was declared."""


class CheckpointError(UsvlearnError):
    """A parameter set that is damaged, or that belongs to another estimator or schema."""


class ConfigError(UsvlearnError):
    """An option outside its legal values."""


class ShapeError(UsvlearnError):
    """Arrays whose shape or dtype do not fit together."""


class MissingExtraError(UsvlearnError, ImportError):
    """An optional dependency that is not installed."""

    def __init__(self, package: str, extra: str, purpose: str):
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed: run `pip install 'usvlearn[{extra}]'`"
        )


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return `value` if it is one of `choices`, else raise a ConfigError that lists them.

    >>> check_choice("feedback", "measured", ("measured", "estimate"))
    'measured'
    """
    if value not in choices:
        raise ConfigError(f"{name}: found {value!r}, expected one of {', '.join(choices)}")
    return value


def check_positive(name: str, value: float, unit: str = "") -> float:
    """Return `value` if it is a positive, finite number, else raise a ConfigError.

    >>> check_positive("dt", 0.4, "s")
    0.4
    """
    if not (isinstance(value, int | float) and 0 < value < float("inf")):
        raise ConfigError(f"{name}: found {value!r}, expected a positive number {unit}".rstrip())
    return value


def bad_input(error: BaseException | None) -> UsvlearnError | None:
    """The UsvlearnError behind an exception, if there is one: constructors are called through others.

    >>> print(bad_input(KeyError()))
    None
    """
    while error is not None and not isinstance(error, UsvlearnError):
        error = error.__cause__ or error.__context__
    return error
