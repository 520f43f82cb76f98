"""What TensorBoard reads of a folder."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

KEEP_ALL = {"scalars": 0, "images": 0, "tensors": 0}


def boards(folder: Path) -> dict[str, EventAccumulator]:
    """All runs below a folder by name, in the order in which TensorBoard gives them colours."""
    runs = {}
    for path in {file.parent for file in folder.rglob("*tfevents*")}:
        runs[path.relative_to(folder).as_posix()] = events = EventAccumulator(str(path), KEEP_ALL)
        events.Reload()
    return dict(sorted(runs.items(), key=lambda item: item[1].FirstEventTimestamp()))


def tags(events: EventAccumulator) -> set[str]:
    """All tags of a run that a person sees."""
    kinds = events.Tags()
    return {tag for kind in ("scalars", "images", "tensors") for tag in kinds[kind] if not tag.startswith("_hparams_")}


def texts(events: EventAccumulator) -> dict[str, str]:
    tags = (tag for tag in events.Tags()["tensors"] if not tag.startswith("_hparams_"))
    return {tag: events.Tensors(tag)[-1].tensor_proto.string_val[0].decode() for tag in tags}


def steps(events: EventAccumulator, tag: str) -> list[int]:
    return [point.step for point in events.Scalars(tag)]


def values(events: EventAccumulator, tag: str) -> list[float]:
    return [point.value for point in events.Scalars(tag)]
