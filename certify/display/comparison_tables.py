"""The result of a comparison in words and tables, for the terminal and for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from certify.analysis.comparison_counts import SEEN, TIERS
from certify.proofs.gauge import STATEMENT
from certify.proofs.rounding import above, below

TITLE = "What Gershgorin loses, and what each condition certifies"
TIMES = {"closed_tight": "closed form", "exact_rate": "exact K", "proof": "p, Λ, LDLᵀ", "box": "box",
         "lmi_first": "LMI first", "lmi_again": "LMI again", "solver": "solver alone"}  # fmt: skip


class Table(NamedTuple):
    """Cells as they are shown; the first column holds names, the others numbers."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


class Part(NamedTuple):
    """A question, its answer in sentences, and the tables and pictures that show it."""

    key: str
    title: str
    said: Sequence[str]
    tables: Sequence[Table]
    pictures: Sequence[str] = ()  # names, see `certify.display.comparison_figures.pictures`


def headline(result: Mapping[str, Any]) -> str:
    """The result in one sentence."""
    theorem = result["theorem"]
    if theorem["false"]:
        return f"The theorem is NOT confirmed: {'; '.join(theorem['false'])} fails on a network of this run."
    if not theorem["networks"]:
        return "No network of this run has a slope, so there is nothing to compare."
    return (
        "By itself Gershgorin's lemma never loses more than a factor of 2 to the LMI, however many neurons: in its "
        "best gauge its smallest rate is σ/K times that of the LMI, and σ/K lies between "
        f"{below(theorem['least'], 3)} and {above(theorem['greatest'], 6)} on the {theorem['networks']:,} networks of "
        "this run."
    )


def highlights(result: Mapping[str, Any]) -> list[str]:
    """What else a reader must know, a sentence each."""
    said = []
    for name, family in result["families"].items():
        if name in ("random", "initialised"):
            continue
        tiers = family["tiers"]
        told = [
            f"{tier} {tiers[tier]['certified']} ({share(tiers[tier]['share'], tiers[tier]['share_interval'])})"
            for tier in ("gershgorin", "lmi", "tight", "box")
        ]
        said.append(
            f"{name}: of {tiers['lmi']['of']} networks simple certifies {tiers['simple']['certified']}, "
            f"{', '.join(told)}."
        )
    alone = sum(
        found["only_gershgorin"] for each in result["families"].values() for found in each["contingency"].values()
    )
    said.append(f"Networks that Gershgorin certifies and the LMI does not: {alone}; by the theorem there are none.")
    if ratios := [row["ratio"] for row in result["timings"] if row["ratio"] is not None]:
        said.append(
            f"The closed form gives the LMI's verdict {_three(min(ratios))} to {_three(max(ratios))} times sooner than "
            "cvxpy and the solver."
        )
    return said


def settings(result: Mapping[str, Any]) -> list[str]:
    """What was compared, in sentences."""
    names = "; ".join(f"{name}: {len(each['networks'])}" for name, each in result["families"].items())
    lines = [
        f"Networks by family: {names}. Drawn families have {result['neurons']} neurons; random: normal weights, K "
        "log-uniform in 0.03 … 3; initialised: as torch.nn.Linear draws them; trained: those after Adam, without "
        "constraint, on one step of a simulated Heron.",
        "Families that are named after a run hold its checkpoints. Sets of one network at different times are not "
        "independent, so they have no intervals.",
        "Brackets are 95 % intervals: Wilson's of a share, order statistics of a median. Random seed "
        f"{result['seed']}; {result['seconds']:g} s for each search on a box; LMI by "
        f"{result['solver'] or 'no solver'}.",
        "∞: the condition holds at no rate, because some |w₁ᵢ| is 1 or more.",
    ]
    return lines + list(result["notes"])


def parts(result: Mapping[str, Any]) -> list[Part]:
    """The result, question by question.

    Args:
        result: see `certify.command.compare.study`.
    """
    found = [_theorem(result), _neurons(result), _shares(result), _contingency(result), _constants(result)]
    found.append(_times(result))
    if result["paper"]:
        found.append(_paper(result["paper"]))
    return found


def _theorem(result: Mapping[str, Any]) -> Part:
    theorem, steps = result["theorem"], "fails" if result["theorem"]["false"] else "holds"
    said = [
        STATEMENT,
        "Why: in its best gauge, |w₁ᵢ| = ½, Gershgorin's smallest rate is 2σ, σ = Σ|sᵢ| = P + N. The LMI's is 2K, "
        "K = max(P, N). P and −N are the sums of the positive and of the negative sᵢ = aᵢ w₁ᵢ.",
    ]
    said.append(
        f"Each step of the proof {steps} on all {theorem['networks']:,} networks with a slope, evaluated in fractions; "
        f"{theorem['one_sign']:,} of them have sᵢ of one sign."
        if not theorem["false"]
        else f"A step of the proof fails: {'; '.join(theorem['false'])}."
    )
    if theorem["without_slope"]:
        said.append(f"{theorem['without_slope']} networks have K = 0, where both rates are 0.")
    said.append(
        "The ratio grows with the share of neurons whose sᵢ has the rarer sign: it is 1 at 0, and comes near 2 at ½ "
        "as n grows."
    )
    rows = [
        [f"{100 * row['rarer']:.0f} %", str(row["n"]), str(row["networks"]), *_spread(row["ratio"])]
        for row in result["by_signs"]
    ]
    rows += [
        [f"{name}, as they are", _sizes(each["networks"]), str(each["with_slope"]), *_spread(each["ratio"])]
        for name, each in result["families"].items()
    ]
    table = Table(
        "σ/K, best-gauge Gershgorin over LMI, by the share of the rarer sign",
        ("rarer sign", "n", "networks", "median", "5 to 95 %", "least", "greatest"),
        rows,
    )
    return Part("gauge", "What does Gershgorin lose to the LMI?", said, [table], ["signs"])


def _sizes(rows: Sequence[Mapping[str, Any]]) -> str:
    sizes = sorted({row["n"] for row in rows})
    return str(sizes[0]) if len(sizes) == 1 else f"{sizes[0]}…{sizes[-1]}"


def _spread(found: Mapping[str, Any] | None) -> list[str]:
    if found is None:
        return ["–"] * 4
    low, high = found["spread"]
    return [
        _middle(found["median"], found["interval"]), f"{_three(low)} to {_three(high)}", below(found["least"], 4),
        above(found["greatest"], 6),
    ]  # fmt: skip


def _neurons(result: Mapping[str, Any]) -> Part:
    tables: list[Table] = []
    said: list[str] = []
    for name in dict.fromkeys(row["family"] for row in result["by_neurons"]):
        rows = [row for row in result["by_neurons"] if row["family"] == name]
        cells = [
            [str(row["n"]), *(_middle(row["tiers"][tier]["median"], row["tiers"][tier]["interval"]) for tier in SEEN)]
            for row in rows
        ]
        title = f"{name} networks, {rows[0]['networks']} of each n: median smallest rate over K"
        tables.append(Table(title, ("n", *SEEN), cells))
        few, many = rows[0], rows[-1]
        medians = {tier: [_three(row["tiers"][tier]["median"]) for row in (few, many)] for tier in SEEN[:4]}
        said.append(
            f"At n = {few['n']} the median smallest rate over K of {name} networks is "
            f"{'; '.join(f'{ends[0]} for {tier}' for tier, ends in medians.items())}."
            if few is many
            else f"From n = {few['n']} to n = {many['n']} the median smallest rate over K of {name} networks goes "
            f"{'; '.join(f'from {ends[0]} to {ends[1]} for {tier}' for tier, ends in medians.items())}."
        )
    said.append(
        "The LMI's smallest rate over K is 2 for every network. In its best gauge Gershgorin's is at most 4, which is "
        "2 times the LMI's 2. In its best gauge simple's lies between 4(n + 1)/n and 4(n + 1), so that no bound holds "
        "for all n."
    )
    return Part("neurons", "How does the loss grow with the number of neurons?", said, tables, ["neurons"])


def _shares(result: Mapping[str, Any]) -> Part:
    tables: list[Table] = []
    said: list[str] = []
    for name, family in result["families"].items():
        rows = []
        for tier in TIERS:
            found = family["tiers"][tier]
            disagreements = "" if found["disagreements"] is None else str(found["disagreements"])
            rows.append([
                tier, f"{found['certified']} of {found['of']}", share(found["share"], found["share_interval"]),
                _middle(found["conservatism"], found["conservatism_interval"]), disagreements,
            ])  # fmt: skip
        tables.append(
            Table(
                f"{name}: {len(family['networks'])} networks, n = {_sizes(family['networks'])}",
                ("condition", "certified", "share", "rate/K, median", "solver disagrees"),
                rows,
            )
        )
        tiers = family["tiers"]
        said.append(
            f"{name}: simple certifies {tiers['simple']['certified']}, gershgorin {tiers['gershgorin']['certified']} "
            f"(in its best gauge {tiers['gershgorin, best gauge']['certified']}), lmi {tiers['lmi']['certified']}, "
            f"tight {tiers['tight']['certified']}, box {tiers['box']['certified']} of {tiers['lmi']['of']}."
        )
    wrong = [
        found["disagreements"] for family in result["families"].values() for found in family["tiers"].values()
        if found["disagreements"] is not None
    ]  # fmt: skip
    if left := sum(not row["closed"] for family in result["families"].values() for row in family["networks"]):
        said.append(
            f"Of {left} networks the rate on the box was not found in {result['seconds']:g} s; its upper bound counts."
        )
    if wrong:
        said.append(f"The solver and the closed forms disagree in {sum(wrong)} verdicts.")
    return Part("shares", "How many networks does each condition certify?", said, tables, ["shares"])


def _contingency(result: Mapping[str, Any]) -> Part:
    rows, alone, missed = [], 0, []
    for name, family in result["families"].items():
        for gauge, found in family["contingency"].items():
            cells = [str(found[key]) for key in ("both", "only_lmi", "only_gershgorin", "neither")]
            rows.append([f"{name}, {gauge}", *cells, share(found["missed"], found["missed_interval"])])
            alone += found["only_gershgorin"]
            if gauge == "best gauge" and found["missed"] is not None:
                missed.append(f"{name}: {found['only_lmi']} of {found['both'] + found['only_lmi']}")
    said = [
        f"Gershgorin alone certifies {alone} networks; the theorem says none."
        if alone == 0
        else f"Gershgorin alone certifies {alone} networks, which CONTRADICTS the theorem."
    ]
    if missed:
        said.append(
            f"Of the networks that the LMI certifies, Gershgorin misses even in its best gauge: {'; '.join(missed)}."
        )
    table = Table(
        "The LMI (Λ) against Gershgorin's lemma",
        ("family, gauge", "both", "only LMI", "only Gershgorin", "neither", "missed of the LMI's"),
        rows,
    )
    return Part("contingency", "Where do the LMI and Gershgorin differ?", said, [table])


def limit(tier: str, n: int) -> float | None:
    """The rate that a condition cannot reach; None of those on a box.

    >>> limit("simple", 20), limit("lmi", 20), limit("box", 20)
    (0.23809523809523808, 0.5, None)
    """
    name = tier.partition(",")[0]
    return {"simple": n / (4 * (n + 1)), "gershgorin": 0.5, "lmi": 0.5, "tight": 1.0}.get(name)


def _constants(result: Mapping[str, Any]) -> Part:
    n, tables = result["neurons"], []
    said: list[str] = []
    for name, family in result["families"].items():
        steps = sorted({row["dt"] for row in family["networks"] if row["dt"]})
        sizes = max(row["n"] for row in family["networks"])
        rows = []
        for tier in TIERS:
            found, most = family["tiers"][tier], limit(tier, sizes)
            largest, constant = found["largest_K"], found["largest_time_constant"]
            rows.append([
                tier, str(found["certified"]), "–" if largest is None else above(largest, 4),
                "–" if most is None else f"< {above(most, 4)}",
                "–" if found["largest_steps"] is None else _three(found["largest_steps"]),
                *(["–" if constant is None else _three(constant)] if steps else []),
            ])  # fmt: skip
        headings = ["condition", "certified", "largest K", "its limit", "−1/ln K, steps"]
        dt = f", dt = {steps[0]:g} s" if len(steps) == 1 else f", dt = {steps[0]:g} … {steps[-1]:g} s" if steps else ""
        tables.append(Table(f"{name}{dt}", headings + ["−dt/ln K, s"] * bool(steps), rows))
        if steps:
            told = [
                f"{tier} {_three(found['largest_time_constant'])} s"
                if (found := family["tiers"][tier])["largest_time_constant"] is not None
                else f"{tier} none"
                for tier in ("simple", "gershgorin", "lmi", "tight")
            ]
            said.append(f"{name}: the largest time constant of a certified network: {', '.join(told)}.")
    low, high = (-1 / math.log(x) for x in (n / (4 * (n + 1)), 0.5))
    said.insert(
        0,
        f"simple certifies no time constant above {above(low, 3)} steps (n = {n}), gershgorin and lmi none above "
        f"{above(high, 3)} steps; tight and box have no such limit.",
    )
    said.append("The rates of interval and box are those on the box, which are at most K; the others are K.")
    return Part("constants", "Which time constants can be certified?", said, tables, ["constants"])


def _times(result: Mapping[str, Any]) -> Part:
    rows, timings = [], result["timings"]
    for row in timings:
        ratio = "–" if row["ratio"] is None else f"{_three(row['ratio'])} ×"
        times = {key: _seconds(row[key]) for key in TIMES}
        if not row["box_closed"]:
            times["box"] = f"> {times['box']}"
        rows.append([str(row["n"]), *times.values(), ratio])
    tables = [Table("Time of one network, by n (m = 4)", ("n", *TIMES.values(), "LMI again / closed form"), rows)]
    rows = []
    for row in result["box_times"]:
        widest = (
            "–" if row["widest"] is None or row["closed"] == len(row["seconds"]) else f"{100 * row['widest']:.2g} %"
        )
        spent = sorted(row["seconds"])
        cells = [_seconds(spent[len(spent) // 2]), _seconds(spent[-1]), f"{row['closed']} of {len(spent)}", widest]
        rows.append([str(row["m"]), *cells])
    title = f"Time of the exact rate on a box, by m (n = {result['box_times'][0]['n']}, initialised networks)"
    tables.append(Table(title, ("m", "median", "longest", "found to 1e-6", "widest gap"), rows))
    said = []
    if solved := [row for row in timings if row["ratio"] is not None]:
        ratios = [row["ratio"] for row in solved]
        said.append(
            f"An LMI that is solved again takes {_three(min(ratios))} to {_three(max(ratios))} times the processor "
            f"time of the closed form, which says the same, for n = {solved[0]['n']} to {solved[-1]['n']}."
        )
        if shares := [row["solver"] / row["lmi_again"] for row in solved if row["solver"] is not None]:
            said.append(
                f"The solver itself needs {100 * min(shares):.0f} to {100 * max(shares):.0f} % of its wall time."
            )
    said.append("All but the search on a box see a and w₁ alone, so that their time does not depend on m.")
    late = [str(row["m"]) for row in result["box_times"] if row["closed"] < len(row["seconds"])]
    said.append(
        f"Within {result['seconds']:g} s the search on a box finds the exact rate of all networks"
        + (f", but not at m = {', '.join(late)}." if late else ".")
    )
    return Part("times", "How long does each verdict take?", said, tables, ["times", "box_times"])


def _paper(tests: Sequence[Mapping[str, Any]]) -> Part:
    headings = ("test", "accepted at 0.999 of its edge", "accepted just beyond", "identity", "wrong")
    rows, wrong = [], []
    for row in tests:
        if "wrong" in row:
            rows.append([row["test"], "", "", "", "{} of {}".format(*row["wrong"])])
            count = row["wrong"][0]
        else:
            count = row["identity"] + max(0, row["beyond"][0] - row["contracting"])
            identity = "accepted" if row["identity"] else "refused"
            rows.append([row["test"], "{} of {}".format(*row["inside"]), "{} of {}".format(*row["beyond"]), identity,
                         f"{count} not contracting"])  # fmt: skip
        if count:
            wrong.append(row["test"])
    said = [f"Wrong on some network: {'; '.join(wrong)}." if wrong else "None of the tests is wrong here."]
    return Part(
        "paper", "Are the paper's tests right, taken literally?", said, [Table("Literally and fixed", headings, rows)]
    )


def share(value: float | None, interval: Sequence[float] | None) -> str:
    """A share with its interval.

    >>> share(0.5, (0.377, 0.623)), share(0.5, None), share(None, None)
    ('50 % [38, 62]', '50 %', '–')
    """
    if value is None:
        return "–"
    return f"{100 * value:.0f} %" + ("" if interval is None else f" [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]")


def _middle(value: float | None, interval: Sequence[float | None] | None) -> str:
    if interval is None or list(interval) == [value, value]:
        return _three(value)
    return f"{_three(value)} [{_three(interval[0])}, {_three(interval[1])}]"


def _three(x: float | None) -> str:
    """Three digits without an exponent.

    >>> _three(1.0), _three(0.01234), _three(12345.0), _three(None)
    ('1.00', '0.0123', '12345', '∞')
    """
    if x is None:
        return "∞"
    digits = max(0, 2 - int(f"{x:e}".partition("e")[2]))
    return f"{x:.{digits}f}"


def _seconds(x: float | None) -> str:
    """
    >>> _seconds(0.00123), _seconds(None), _seconds(2e-10)
    ('1.23 ms', '–', '0.0002 µs')
    """
    if x is None:
        return "–"
    for scale, unit in ((1.0, "s"), (1e3, "ms")):
        if x * scale >= 1:
            return f"{_three(x * scale)} {unit}"
    return f"{x * 1e6:.3g} µs"
