"""What Gershgorin's lemma loses to the LMI, and which networks, of runs too, each condition certifies.

python benchmarks/certify_compare.py RUN …     writes docs/benchmarks/certify_compare.md and its pictures

The page is that of `python -m certify compare RUN … --page FOLDER`, with the machine on which the times were measured.
"""

import sys

from pages import FOLDER, publish
from timing import machine

from certify.compare import parse, study
from certify.comparison_figures import pictures
from certify.comparison_page import markdown
from certify.figures import svg_of_page

NAME = "certify_compare"


def main() -> None:
    computer, result = machine(), study(parse(sys.argv[1:]))
    drawn = pictures(result)
    for name, picture in drawn.items():
        (FOLDER / f"{NAME}_{name}.svg").write_bytes(svg_of_page(picture.figure, name)[1])
    command = " ".join([f"python benchmarks/{NAME}.py", *sys.argv[1:]])
    text = markdown(result, drawn, command, f"{NAME}_{{}}.svg")
    publish(
        __file__, f"{text}\nTimes: {computer}. Other work ran beside it; a ratio is the median of rounds in turn.\n"
    )


if __name__ == "__main__":
    main()
