"""What a step, a grid and whole jobs cost, measured in one run.

python benchmarks/speed.py                       all, ten minutes; wants the extras bench and plot, and an idle machine
python benchmarks/speed.py --only steps          one section, printed alone
python benchmarks/speed.py --quick               all, on little data: whether it runs
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import speed_jobs
import speed_steps
import torch
from pages import FOLDER
from timing import QUICK, WHOLE, Effort, Section, machine

SECTIONS: dict[str, tuple[str, Callable[[Effort], Section]]] = {
    "steps": ("A step", speed_steps.steps),
    "others": ("Other libraries", speed_steps.others),
    "elements": ("Batch elements", speed_jobs.elements),
    "jobs": ("Whole jobs", speed_jobs.jobs),
    "memory": ("Memory", speed_jobs.memory),
    "growth": ("How a step grows", speed_steps.growth),
    "around": ("Around a replay", speed_jobs.around),
}


def page(folder: Path, effort: Effort, names: list[str]) -> str:
    """The page, as Markdown; its figures are saved in the folder."""
    text = [
        "# Speed of steps and jobs",
        "",
        "Measured by `python benchmarks/speed.py` in one run: float64, one thread where not said otherwise, medians of",
        f"{effort.repeats} rounds in which all works of a row are timed in turn.",
        "",
        f"{machine()}.",
        "",
    ]
    for name in names:
        title, measure = SECTIONS[name]
        print(f"{title} …", flush=True)
        found = measure(effort)
        text += [f"## {title}", "", *found.lines, ""]
        for figure, drawn in found.figures.items():
            path = folder / f"speed_{figure}.svg"
            drawn.savefig(path, metadata={"Date": None})
            text += [f"![{title}]({path.name})", ""]
    return "\n".join(text)


@torch.no_grad()
def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section, printed alone")
    asked.add_argument("--quick", action="store_true", help="on little data")
    asked.add_argument(
        "--folder", type=Path, help="of the page and its figures; a whole run's by default is docs/benchmarks/"
    )
    given = asked.parse_args()
    whole = given.only is None and not given.quick
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as spare:
        folder = given.folder or (FOLDER if whole else Path(spare))
        folder.mkdir(parents=True, exist_ok=True)
        text = page(folder, QUICK if given.quick else WHOLE, [given.only] if given.only else list(SECTIONS))
        (folder / "speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
