"""What Gershgorin's lemma loses to the LMI, and which networks, of runs too, each condition certifies.

python benchmarks/certify_compare.py     six minutes; writes docs/benchmarks/certify_compare.md and its pictures

The page is that of the last command of COMMANDS, with the machine on which the times were measured. The commands before
it make the runs whose networks are compared, one of an example's logs and one of a simulated fleet.
"""

import contextlib
import shlex
import subprocess
import sys
import tempfile
from importlib.metadata import version

from pages import FOLDER, publish
from timing import load, machine

from certify.command.compare import parse, study
from certify.display.comparison_figures import pictures
from certify.display.comparison_page import markdown
from certify.display.figures import svg_of_page

NAME = "certify_compare"
BUSY = 1.7  # load from which on other work is mentioned: this one is 1
COMMANDS = """\
python -m usvlearn example logs
python -m usvlearn inspect logs --name heron
python -m usvlearn train data=my_boat.yaml hydra.run.dir=outputs/heron
python -m usvlearn train data=simulated data.n=8 data.hours=0.5 align.dt=0.2 hydra.run.dir=outputs/fleet
python -m certify compare outputs/heron outputs/fleet --page page"""


def main() -> None:
    *runs, compare = map(shlex.split, COMMANDS.splitlines())
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for command in runs:
            print(*command, file=sys.stderr)
            subprocess.run([sys.executable, *command[1:]], check=True, stdout=subprocess.DEVNULL)
        computer, result = machine(), study(parse(compare[4:]))
    drawn = pictures(result)
    for name, picture in drawn.items():
        (FOLDER / f"{NAME}_{name}.svg").write_bytes(svg_of_page(picture.figure, name)[1])
    text = markdown(result, drawn, COMMANDS, f"{NAME}_{{}}.svg")
    solvers = ", ".join(f"{name} {version(name)}" for name in ("cvxpy", "clarabel"))
    busy = " Other work ran on the machine, which makes the times uncertain." if (load() or 0) > BUSY else ""
    text = text.replace("```sh\n", "<!-- not run: the comparison takes minutes -->\n```sh\n")
    publish(__file__, f"{text}\nTimes: {computer}; {solvers}. A ratio is the median of rounds in turn.{busy}\n")


if __name__ == "__main__":
    main()
