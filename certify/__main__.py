"""python -m certify PATH…: is a learned network contracting, and by which proof?"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from certify.command import verification
from certify.command.judged import input_of, judge, write_certificates
from certify.errors import CertifyError, complain
from certify.networks.shallow import Network, find
from certify.networks.vector import activation, read_both
from certify.proofs import vector_certificate
from certify.proofs.certificate import CONDITIONS

CERTIFIED, NOT_ALL, BAD_INPUT, FAULT, STOPPED = 0, 1, 2, 3, 130  # exit codes
EVERY_CONDITION = (*CONDITIONS, *(name for name in vector_certificate.CONDITIONS if name not in CONDITIONS))
LONGEST_TIME = 1e9  # s
EPILOG = """
exit code: 0 all certified by --condition, 1 not all, 2 bad input, 3 a fault of certify, 130 Ctrl-C

python -m certify outputs/RUN                             the checkpoints of a run
python -m certify 'outputs/*/checkpoints/heron/*' --box   with the exact rate on the operating box
python -m certify net.npz --certificate proofs            a JSON certificate each
python -m certify --verify proofs/*.json                  check certificates, without solver and torch
python -m certify net3.npz --lmi --steps                  a state of several components: A, W, W2, b, and R, V, c
python -m certify rnn.pt --nonlinearity relu              the state_dict of a torch.nn.RNN or RNNCell
python -m certify compare outputs/RUN --lmi              all conditions side by side, see compare --help
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if sys.stdout is None:  # closed
        sys.stdout = open(os.devnull, "w")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        if arguments[:1] == ["compare"]:
            from certify.command import compare

            return compare.main(arguments[1:], _say)
        return _run(_parse(arguments))
    except (CertifyError, OSError) as error:
        return _error(error)
    except KeyboardInterrupt:
        print("stopped: the certificates written so far are complete", file=sys.stderr)
        return STOPPED
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "certify"):
            traceback.print_exc()
            return FAULT
        return _error(f"the package {package} is not installed: run `pip install {package}`")
    except Exception:  # the exit code 1 of Python would mean "not all"
        traceback.print_exc()
        return FAULT


def _error(error: Exception | str) -> int:
    """Print one line on standard error; returns the exit code of bad input."""
    complain(f"error: {' '.join(str(error).split())}")
    return BAD_INPUT


def parser() -> argparse.ArgumentParser:
    """The arguments of the command."""
    parser = argparse.ArgumentParser(
        "python -m certify", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="*", metavar="PATH", help="checkpoints, folders of runs, patterns")
    parser.add_argument("--condition", choices=EVERY_CONDITION, help="what is judged (default: exact)")
    parser.add_argument("--lmi", action="store_true", help="solve both linear matrix inequalities too (extra lmi)")
    parser.add_argument("--solver", default="CLARABEL", help="of --lmi, a name that cvxpy knows (default: CLARABEL)")
    parser.add_argument(
        "--box",
        nargs="?",
        const="",
        metavar="LO:HI,…",
        help="search the exact rate on a box of x, u₁ … u_m; by default x and headings in 0:1, commands in -1:1",
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="of the search on a box, each (default: 10)")
    parser.add_argument(
        "--input", metavar="U,…", help="u at which equilibria are listed (default: zeros, as in the paper)"
    )
    parser.add_argument(
        "--activation",
        "--nonlinearity",
        metavar="PHI",
        help="of the networks: relu, tanh or leaky:α (default: what the file states, else relu, tanh of torch.nn.RNN; "
        "--verify: as claimed)",
    )
    parser.add_argument("--steps", action="store_true", help="prove also that all steps up to the largest contract")
    parser.add_argument("--dt", type=float, metavar="S", help="step in s, to give time constants in s")
    parser.add_argument("--json", action="store_true", help="a list of objects on standard output")
    parser.add_argument(
        "--certificate", metavar="DIR", help="write a JSON certificate of each checkpoint that is certified"
    )
    parser.add_argument(
        "--plot",
        metavar="FILE",
        help="draw the map and its equilibria; FILE, FILE-2, … for several checkpoints",
    )
    parser.add_argument("--headings", action="store_true", help="of --plot: the maps at rest over all headings")
    parser.add_argument(
        "--verify", nargs="+", metavar="CERTIFICATE", help="check certificates, of PATH or what they name"
    )

    def refuse(message: str) -> NoReturn:
        raise CertifyError(f"{message}: see --help")

    parser.error = refuse  # type: ignore[method-assign]  # argparse calls this method, and would end the program
    return parser


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    options = parser().parse_args(_joined(arguments))
    options.paths = [each.removeprefix("runs=") for each in options.paths]  # as evaluate takes it
    if options.box and ":" not in options.box:  # --box PATH
        options.paths, options.box = [options.box, *options.paths], ""
    if options.condition in ("interval", "box") and options.box is None:
        options.box = ""
    if not (options.paths or options.verify):
        raise CertifyError("no PATH is given: give checkpoints, a run's folder or a pattern (see --help)")
    for name, value in (("seconds", options.seconds), ("dt", options.dt)):
        if value is not None and not 0 < value <= LONGEST_TIME:
            raise CertifyError(f"--{name}: found {value}, expected a number above 0, at most {LONGEST_TIME:g}")
    return options


def _joined(arguments: Sequence[str]) -> list[str]:
    """The arguments; a negative number after --box or --input is joined to it, so that it is not read as an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--box", "--input") and re.match(r"-([\d.]|inf|nan)", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _run(options: argparse.Namespace) -> int:
    phi = None if options.activation is None else activation(options.activation)
    code, networks, vectors = CERTIFIED, [], []
    for path in find(options.paths):
        try:
            most = verification.MOST_NETWORKS if options.verify else math.inf
            shallow, others = read_both(path, phi, as_vectors=options.steps and not options.verify, most=most)
        except CertifyError as error:  # the other files are still judged
            code = _error(error)
            continue
        networks += shallow
        vectors += others
    if options.paths and not networks and not vectors:
        return code
    if options.headings and any(network.inputs != 4 for network in networks):
        raise CertifyError("--headings: found a network without the four inputs of heading and commands")
    if options.plot is not None and (not options.plot or options.plot.endswith(os.sep) or Path(options.plot).is_dir()):
        raise CertifyError(f"--plot: found {options.plot!r}, expected a file such as map.png")
    if options.verify:
        results = verification.verify(options.verify, networks, vectors, options.activation)
        for refused in results.problems:
            code = _error(refused)
        if results.rows:
            _say(print, json.dumps(results.rows, indent=1) if options.json else "\n".join(results.lines))
        return max(code, CERTIFIED if all(row["valid"] for row in results.rows) else NOT_ALL)
    judged, failures = judge(options, [*networks, *vectors])
    for failure in failures:
        code = _error(failure)
    if not judged:
        return code
    rows, notes = [each.row for each in judged], []
    if options.certificate is not None:
        folder = Path(options.certificate)
        if not options.certificate or (folder.exists() and not folder.is_dir()):
            raise CertifyError(
                f"--certificate: found {options.certificate!r}, which is a file or empty, expected a folder"
            )
        written, too_long = write_certificates(folder, judged)
        for each in too_long:
            code = _error(f"{each}: is certified, but its proof is longer than --verify reads: it has no file")
        notes.append(f"{written} certificates: {folder}; check them with --verify")
    if options.plot:
        notes += _plot(options, [each.network for each in judged if isinstance(each.network, Network)])
    if options.json:
        _say(print, json.dumps(rows, indent=1, allow_nan=False))
        for note in notes:
            print(note, file=sys.stderr)
    else:
        from certify.display.tables import show

        _say(show, rows, options.condition, notes, options.dt)
    return max(code, CERTIFIED if all(row["judged"] for row in rows) else NOT_ALL)


def _say(write: Callable, *arguments: Any) -> None:
    """Write to standard output; if its reader closes the pipe early, the verdict stays the same."""
    try:
        write(*arguments)
        sys.stdout.flush()
    except (BrokenPipeError, SystemExit):  # rich turns a broken pipe into SystemExit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _plot(options, networks: Sequence[Network]) -> list[str]:
    from certify.display.figures import equilibria_figure, save
    from certify.proofs.equilibria import surge_inputs

    file, written = Path(options.plot), []
    for k, network in enumerate(networks):
        path = file if k == 0 else file.with_name(f"{file.stem}-{k + 1}{file.suffix}")
        headings = np.linspace(0.0, 2 * np.pi, 24, endpoint=False) if options.headings else None
        u = input_of(options.input, network.inputs, network.path) if headings is None else surge_inputs(headings)
        save(equilibria_figure(network.weights, u, network.path, headings=headings), path)
        written.append(str(path))
    return [f"pictures: {', '.join(written[:3])}{f' … {written[-1]}' if len(written) > 3 else ''}"]


if __name__ == "__main__":
    sys.exit(main())
