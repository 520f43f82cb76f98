"""The command `usvlearn`, its commands, and the first words and the help of those of Hydra."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence

import usvlearn
from usvlearn.errors import complain, drop_output

USAGE = "usage: usvlearn COMMAND ARGUMENTS, COMMAND --help or --version"
COMMANDS = {  # name -> the module whose `main` does it, and what it does
    "train": ("usvlearn.cli.train", "replay logs through estimators online, save what they learn"),
    "evaluate": ("usvlearn.cli.evaluate", "judge saved runs, compare the jobs of a sweep, or make a study"),
    "example": ("usvlearn.cli.example", "write logs of a simulated boat, to try the other commands on"),
    "inspect": ("usvlearn.cli.inspect", "tell what your logs hold, and write their configuration"),
    "check": ("usvlearn.cli.check", "tell in five lines what logs are good for, and what is missing"),
    "export": ("usvlearn.cli.export", "write what was learned for C, MATLAB, CasADi, ONNX, Gazebo, CSV"),
    "fit": ("usvlearn.cli.fit", "fit the model to all logs of a run, for its best parameters"),
    "compare": ("usvlearn.cli.compare", "tell what changed between runs: dates, boats or settings"),
    "controller": ("usvlearn.cli.controller", "design speed and steering from what a run has identified"),
    "plan": ("usvlearn.cli.plan", "tell what to sail next to narrow the confidence intervals"),
    "live": ("usvlearn.cli.aboard", "learn aboard: a node on MOOS, MAVLink or ROS 2, and its status"),
    "warm": ("usvlearn.cli.warm", "compile everything ahead of need, when a boat's computer is set up"),
    "certify": ("certify.__main__", "prove whether the networks in checkpoints contract"),
}
QUICK = ("live",)  # which say something themselves
FLAGS = {"--help=all": "--help", "--animate": "animate=true", "--paper": "paper=true"}  # as Hydra knows them
HELP = {
    "train": """\
usage: {program} my_boat.yaml [KEY=VALUE …] [FLAG …]
Learns online from logs, and saves errors, checkpoints and predictions.

  my_boat.yaml               which logs; usvlearn inspect LOGS writes this file
  data=simulated             logs of a simulated boat; the default
  hydra.run.dir=FOLDER       where the run is saved (outputs/DATE_TIME)
  resume=FOLDER|latest       continue a run; `latest` with its hydra.run.dir
  vehicle.mass=36            kg, of the boat
  align.dt=0.4               s, step of the predictions
  estimators.rnn.neurons=20  any setting of a member; ~estimators.rnn removes it
  output=ensemble            the combiner that predicts
  seed=0                     of initial weights, simulated data and search
  check=warn                 the data before a run: warn, strict, off
  grid=aid                   tune a member; learn=aid and search=aid, too
  -m KEY=1,2 seeds=5         a sweep: a run for each value and seed
  sweep=inputs               a sweep of configs/sweep, with -m
  experiment=paper_small     the settings of configs/experiment

  --all                      print all rows, not only the main ones
  --cfg job                  print the settings that these arguments make
  --config-dir FOLDER        more configurations of your own
  --help=all                 every key with its default, and every group
  --hydra-help               every flag""",
    "evaluate": """\
usage: {program} RUN [my_boat.yaml] [KEY=VALUE …]
Writes a report of a run: errors, open-loop simulations, certificates,
parameters. Of a sweep it prints the leaderboard.

  RUN                     a folder that train has written, or one of several
  my_boat.yaml            judge on other logs of the same boats
  report=FOLDER           of the report (RUN/report)
  objective=MEMBER.skill  ranks the jobs of a sweep, also by .mae, .coverage,
                          .forecast.SECONDS or .free
  experiment=paper_small  make a whole study from nothing; or paper
  trust=MODULE            saved settings may name its classes: only if you trust
                          its code
  --animate               also a GIF of the tracks with their ellipses
  --paper                 also LaTeX, with figures, tables and equations

  --all                   print all rows of tables
  --help=all              every key with its default
  --hydra-help            every flag""",
}


def begin(name: str) -> None:
    """Print the help of a command of Hydra and end, if that is asked for; else say on a terminal what is loading."""
    arguments = sys.argv[1:]
    if name in HELP and ("--help" in arguments or "-h" in arguments):
        program = f"python {sys.argv[0]}" if sys.argv[0].endswith(".py") else sys.argv[0]
        print(HELP[name].format(program=program), flush=True)
        sys.exit(0)
    sys.argv[1:] = [FLAGS.get(each, each) for each in arguments]
    if (
        name not in QUICK
        and (arguments or name in HELP)
        and not {"-h", "--help", "--help=all"} & {*arguments}
        and sys.stderr.isatty()
    ):
        print(f"usvlearn {name}: loading …", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Hand the arguments to a command; returns the exit code."""
    try:
        code = _main(sys.argv[1:] if arguments is None else arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except BrokenPipeError:
        drop_output()
        return 0


def _main(arguments: Sequence[str]) -> int:
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        print(USAGE, "", *(f"  {each:12}{what}" for each, (_, what) in COMMANDS.items()), sep="\n")
        return 0
    if name == "--version":
        print("usvlearn", usvlearn.__version__)
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else "see usvlearn --help"
        complain(f"error: found the command {name!r}, expected one of {', '.join(COMMANDS)}: {hint}")
        return 2
    sys.argv = [f"usvlearn {name}", *rest]
    begin(name)
    try:
        module = importlib.import_module(COMMANDS[name][0])
        if hasattr(module, "main"):
            return module.main() or 0
        from usvlearn.cli.plain_command import run_command

        return run_command(module.work, module.USAGE)
    except ModuleNotFoundError as error:
        if (package := (error.name or "").partition(".")[0]) in ("", "usvlearn", "certify"):
            raise
        complain(
            f"error: usvlearn {name} needs the package {package}, which is not installed (usvlearn-aboard leaves it "
            "out): use an environment where all of usvlearn is installed, by `pip install .`"
        )
        return 2
