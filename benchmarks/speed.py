"""What a step, a grid and whole jobs cost, measured in one run.

python benchmarks/speed.py                       all, ten minutes; wants the extra bench and an idle machine
python benchmarks/speed.py --only steps          one section, printed alone
python benchmarks/speed.py --quick               all, on little data: whether it runs
"""

import argparse
from collections.abc import Callable

import speed_jobs
import speed_steps
import torch
from pages import publish
from timing import QUICK, WHOLE, Effort, machine

SECTIONS: dict[str, tuple[str, Callable[[Effort], list[str]]]] = {
    "steps": ("A step", speed_steps.steps),
    "others": ("Other libraries", speed_steps.others),
    "elements": ("Batch elements", speed_jobs.elements),
    "jobs": ("Whole jobs", speed_jobs.jobs),
    "around": ("Around a replay", speed_jobs.around),
}


def page(effort: Effort, names: list[str]) -> str:
    """The page, as Markdown."""
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
        text += [f"## {title}", "", *measure(effort), ""]
    return "\n".join(text)


@torch.no_grad()
def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section, printed alone")
    asked.add_argument("--quick", action="store_true", help="on little data")
    given = asked.parse_args()
    torch.set_num_threads(1)
    text = page(QUICK if given.quick else WHOLE, [given.only] if given.only else list(SECTIONS))
    if given.only is None and not given.quick:
        publish(__file__, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
