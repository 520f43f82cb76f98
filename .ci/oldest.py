"""Print the oldest versions that pyproject.toml allows, one requirement a line: `python .ci/oldest.py EXTRA …`.

They are those of the dependencies, of the extras that are named, and of `aboard`. Torch is left out: only its newest
versions exist as small builds for the processor alone.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
LEFT_OUT = ("torch", "usvlearn")


def oldest(extras):
    """The lower bound of each requirement, as `name==version`.

    Raises:
        ValueError: a requirement has no lower bound, or two of the same package differ.
    """
    found = {}
    for file in ("pyproject.toml", "aboard/pyproject.toml"):
        project = tomllib.loads((ROOT / file).read_text())["project"]
        some = [each for name, group in project["optional-dependencies"].items() if name in extras for each in group]
        for requirement in project["dependencies"] + some:
            match = re.match(r"([\w-]+)(?:\[[\w,]+\])?>=([\w.]+)", requirement)
            if match is None and not requirement.startswith(LEFT_OUT):
                raise ValueError(f"{file}: found {requirement!r}, expected NAME>=VERSION")
            if match is None or match[1] in LEFT_OUT:
                continue
            if found.setdefault(match[1], match[2]) != match[2]:
                raise ValueError(f"{file}: found {requirement!r}, elsewhere {match[1]}>={found[match[1]]}")
    return [f"{name}=={version}" for name, version in found.items()]


if __name__ == "__main__":
    print("\n".join(oldest(sys.argv[1:])))
