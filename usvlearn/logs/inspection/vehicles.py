"""Which vehicle a log is of: one of several that a telemetry log holds, and whether it is a boat at all."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.series import Series
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.servos import FUNCTION, FUNCTIONS
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import UNSURE, Decision
from usvlearn.logs.inspection.vocabulary import fit, side

TYPE = re.compile(r"HEARTBEAT(@\S*)? type|vehicle_status system_type")  # series of MAVLink's MAV_TYPE
OF_VEHICLES = tuple(map(re.compile, (r"/([^/]+)/.+", r"([A-Za-z]+\d*)[._].+", r".*?[A-Za-z][ _.]?(\d+)")))  # in names
SENDERS = tuple(map(re.compile, (r"/([^/ ]+)/(\S+) .*", r"ATTITUDE\S* (\d+)\.(\d+)", r"DB_TIME MOOSDB_(.+)()")))
GROUND, BOAT = 10, 11  # a car; boats that run its firmware may keep this type
OTHERS = {1: "an aeroplane", 12: "a submarine", **dict.fromkeys((2, 3, 4, 13, 14, 15, 29, 35), "a multicopter"),
          **dict.fromkeys(range(19, 26), "a VTOL aeroplane")}  # fmt: skip
FIRMWARE = re.compile(rb"(?:Ardu|APM:)(Plane|Copter|Sub) ?V\d")  # as the log's own text says
FIRMWARES = {b"Plane": "an aeroplane", b"Copter": "a multicopter", b"Sub": "a submarine"}
WINGS, MOTORS = {4, 19, 77, 78, 79, 80}, {*range(33, 41), *range(82, 86)}  # values of SERVOn_FUNCTION
OF_BOATS = {*FUNCTIONS.values()}


def of_one_vehicle(series: Sequence[Candidate], convention: str) -> tuple[list[Candidate], list[Decision]]:
    """The series of one vehicle; of several, those of the first that has commands, and a question.

    Systems of a telemetry log are vehicles. So are namespaces, prefixes or numbers of names, if each has all there is.
    """
    telemetry = convention == "MAVLink telemetry"
    for system in _vehicles_of(series, telemetry):
        known = [(system[id(each)], each.label) for each in series if id(each) in system and each.varies]
        headed = {one for one, label in known if fit("heading", label) >= 2}
        sided = [{one for one, label in known if side(label.replace(one, "", 1)) == way} for way in ("left", "right")]
        driven = {one for one, label in known if fit("command", label) >= 1} | (sided[0] & sided[1])
        systems = sorted(filter(str.isdigit, headed), key=int) if telemetry else sorted(headed & driven)
        if len(systems) < 2:
            continue
        chosen = next((each for each in systems if each in driven), systems[0])
        others = tuple(each for each in systems if each != chosen)
        why = f"the log holds {len(systems)} vehicles, {', '.join(systems)}, and this is one of them: of another one, "
        one, other = (f"@{each}.1" if telemetry else repr(each) for each in (chosen, others[0]))
        why += f"write {other} in place of {one} in data.channels"
        foreign = {*system.values()} - {chosen} if telemetry else {*others}  # what no vehicle has, is of all
        remaining = [each for each in series if system.get(id(each)) not in foreign]
        return remaining, [Decision("vehicle", "system", chosen, UNSURE, why, others)]
    return list(series), []


def _vehicles_of(series: Sequence[Candidate], telemetry: bool) -> Iterator[dict[int, str]]:
    """Series, by `id` -> the vehicle that they may be of: by the sender, or by each way in which names tell it."""
    if telemetry:
        yield {id(each): each.kind.partition(".")[0] for each in series}
    else:
        yield from ({id(each): key[1] for each in series if (key := one.fullmatch(each.name))} for one in OF_VEHICLES)


def told_apart(logs: Sequence[Sequence[Series]]) -> dict[str, str]:
    """boat -> a word for its logs, where these tell the same of several systems, communities or namespaces; else {}."""
    heard: list[dict[str, set[str]]] = [{} for _ in logs]
    for log, senders in zip(logs, heard, strict=True):
        for each, one in product(log, SENDERS):
            if match := one.fullmatch(f"{each.name} {each.kind}"):
                senders.setdefault(match[1], set()).add(f"{match[2]} {each.field}")
    for other, (one, own) in product(heard[1:], heard[0].items()):
        for another in () if one in other else sorted(other.keys() - heard[0].keys()):
            if 2 * len(own & other[another]) > min(len(own), len(other[another])):
                return {one: "FILE", another: "FILE"}
    return {}


def check_boat(files: Sequence[Path], series: Sequence[Candidate], convention: str) -> list[Decision]:
    """Refuse the log of an aeroplane, a multicopter or a submarine; ask where a log is of a ground vehicle."""
    kinds = {round(float(each.value[-1])) for each in series if TYPE.fullmatch(each.label)}
    foreign = next((OTHERS[kind] for kind in kinds if kind in OTHERS and not kinds & {GROUND, BOAT}), "")
    log = DataFlash()._log(files[0]) if convention == "ArduPilot DataFlash" else None
    parameters = log.vehicles[""].parameters if log else {}
    servos = {value for name, value in parameters.items() if FUNCTION.fullmatch(name)}
    if servos & WINGS or (servos & MOTORS and not servos & OF_BOATS):
        foreign = "an aeroplane" if servos & WINGS else "a multicopter or a submarine"
    if log and (text := FIRMWARE.search(log.data.data)):
        foreign = FIRMWARES[text[1]]
    if foreign:
        raise LogFormatError(
            f"{files[0]}: found a log of {foreign}, expected one of a boat: give one, or add --any-vehicle if it is one"
        )
    if GROUND in kinds or (servos & OF_BOATS and parameters.get("FRAME_CLASS") == 1):
        why = "the log says that it is a ground vehicle, as boats do that keep the settings of one: is it a boat?"
        return [Decision("vehicle", "kind", "a boat", UNSURE, why, ("a car: its log teaches nothing about a boat",))]
    return []
