"""The job of train.py and `usvlearn train`: replay runs online and save what was learned, or tune a member.

What needs torch is imported where it is used: --help must not wait for it.
"""

import shlex
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from usvlearn.cli.fit import fit_on_the_way
from usvlearn.cli.hydra_command import command
from usvlearn.cli.replay_fits import FITTED, fits_of, replay_with_fits, takes_fits
from usvlearn.cli.signals import until_stopped
from usvlearn.cli.sweep import do_job
from usvlearn.composition.alignment import CheckedAlignment
from usvlearn.composition.configuration import as_written, check_settings, ensemble_of, instantiate, plain, planar_of
from usvlearn.core.unconfirmed import SECTION, open_questions, unconfirmed
from usvlearn.display import terminal
from usvlearn.display.terminal import Activity
from usvlearn.errors import check_positive
from usvlearn.logs.setup import setups_of
from usvlearn.report.summary import Quantities, displayed, summary
from usvlearn.report.tables import (
    TOGGLE,
    board_lines,
    error_tables,
    event_lines,
    identified_table,
    program,
    quoted,
    rejection_table,
    track_table,
)
from usvlearn.runs.files import TENSORBOARD
from usvlearn.sweeps.launchers import set_threads
from usvlearn.sweeps.seeds import seeded
from usvlearn.sweeps.tuning import asked


def work(cfg: DictConfig, folder: Path, overrides: Sequence[str], resume: str | None = None, quiet=False) -> float:
    """Do what is asked for, a replay or tuning; quiet where workers share the terminal. Returns the objective."""
    check_settings(cfg)
    composed = seeded(plain(cfg))
    still = {SECTION: open_questions(composed, overrides)} if SECTION in composed else {}
    composed_cfg = OmegaConf.create(composed | still)
    console = terminal.console(quiet)  # of its own: what a worker is sent must be picklable
    with as_written(cfg):
        if not asked(composed_cfg):
            from usvlearn.engine.background_compile import compile_ahead

            with nullcontext() if quiet else compile_ahead(tracks=composed_cfg.get("tracks") is not None):
                return train(composed_cfg, folder, console, resume or cfg.resume, overrides)
        with Activity(console, "loading"):
            from usvlearn.sweeps.tuning.tune import tune
        settings = plain(composed_cfg)
        return tune(settings, folder, instantiate, CheckedAlignment(settings, console), overrides, console)


def train(cfg: DictConfig, folder: Path, console: Console, resume: str | None, overrides: Sequence[str] = ()) -> float:
    """Replay what the configuration names into the run's folder; returns the objective."""
    with Activity(console, "loading"):
        from usvlearn.estimators.axis.turning_intervals import FIRST
        from usvlearn.evaluation.diagnostics import explained, identified_boats, remarks
        from usvlearn.evaluation.objective import check_measure, measure_of
        from usvlearn.report.sections.network import stability
        from usvlearn.runs.compared import what_differs
        from usvlearn.runs.replay import replay
        from usvlearn.runs.run_folder import RunFolder
        from usvlearn.runs.tensorboard import TensorBoardLogger, check_log
        from usvlearn.simulate.truth import quantities_of, turning_of

    began, settings = time.perf_counter(), {**plain(cfg), "resume": None}
    set_threads(cfg.threads, int(cfg.seed))
    check_log(log := cfg.get("log", "main"))
    save_minutes = check_positive("save_minutes", cfg.save_minutes, "of min")
    save_every = max(1, round(60 * save_minutes / check_positive("align.dt", cfg.align.dt)))
    align = CheckedAlignment(settings, console)
    with Activity(console):
        ensemble = ensemble_of(cfg)
        planar, without = planar_of(cfg, ensemble)
        recordings = list(instantiate(cfg.data))
        fleet = align(recordings, **cfg.align)
        if refits := bool(cfg.get("refit")) and len(fleet.runs) > 1 and takes_fits(ensemble):
            cfg.forecasts._target_ = FITTED  # from now on, as it is in what is saved
            ensemble, settings = ensemble_of(cfg), {**plain(cfg), "resume": None}
            planar, without = planar_of(cfg, ensemble)
    whole = terminal.ALL in terminal.asked
    if whole and (rejected := rejection_table(fleet.rejected)) is not None:
        console.print(rejected)
    check_measure(measure_of(cfg.get("objective"), ensemble.output), ensemble, fleet)
    setups = {boat: each.json() for boat, each in setups_of(settings, recordings).items()}
    run = RunFolder(folder, fleet, ensemble, settings, planar, align.json, setups)
    start = run.begin(ensemble.init((len(fleet.boats),)), resume)
    terminal.show(start.note, *filter(None, (without, start.anew)), to=console)
    truth, turns = quantities_of([settings["data"]], cfg.vehicle.mass), turning_of([settings["data"]])
    logger = TensorBoardLogger(
        folder / TENSORBOARD, fleet, ensemble, start.position, what_differs(overrides), truth, log,
        described(cfg, overrides), alone=not console.quiet, tracks=() if planar is None else planar.horizons,
    )  # fmt: skip
    with run, logger, Activity(console) as activity:
        activity.begin("replaying", total=fleet.steps)
        if refits:
            chunks = replay_with_fits(run, start.position, fits_of(run, recordings, cfg), logger.every, save_every)
        else:
            chunks = replay(ensemble, fleet, start.state, start.position, logger.every, save_every, planar, run.beside)
        for chunk in until_stopped(chunks, lambda: run.stop(began)):
            run.save(chunk)
            logger.show(chunk)
            activity.tell(f"replaying run {chunk.end.run + 1} of {len(fleet.runs)}")
            activity.completed(fleet.steps_before(*chunk.end))
        activity.begin("scoring")
        results = run.finish(began, truth | turns)
        networks = stability(ensemble, run.state, fleet.boats, results.get("free"))
        logger.finish(settings, results, run.published, networks)
    quantities = identified_boats(ensemble, run.state, fleet.boats)
    main = None if whole else (ensemble.output, ensemble.members)
    console.print(error_tables(results["boats"], remarks(ensemble), explained(ensemble), results.get("forecast"), main))
    if whole and (tracks := track_table(results.get("tracks"))) is not None:
        console.print(tracks)
    console.print(identified_table(quantities, truth, whole))
    known: dict[str, Quantities] = {boat: displayed(each) for boat, each in quantities.items()}
    if cfg.get("refit"):
        known |= fit_on_the_way(folder, console)
    elif planar is not None and whole:
        terminal.show(FIRST, to=console)
    happened = [*event_lines(results["events"], whole)[1:], *(networks if whole else ())]
    terminal.show("", *happened, *[""] * bool(happened), to=console)
    several, asked_still = len(fleet.boats) > 1, open_questions(settings)
    if align.findings is None:  # nothing was checked, so that nothing was said of them
        terminal.show(*unconfirmed(asked_still), "", to=console)
    board, *page = board_lines(folder / TENSORBOARD, f"?smoothing=0{'&runFilter=fleet%2F' * several}#timeseries")
    terminal.show(
        *summary(results, asked_still, known),
        *([board, *page, *[TOGGLE] * several] if whole else [board]),
        f"next         {program('evaluate')} {quoted(folder)}",
        to=console,
    )
    return results["objective"]


def described(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, str]:
    """The configuration as Markdown by title, and the command that makes the run again."""
    blocks = {
        "command": ("sh", shlex.join(["python", "train.py", *overrides])),
        "settings that differ": ("", "\n".join(overrides) or "none"),
        "configuration": ("yaml", OmegaConf.to_yaml(cfg)),
    }
    return {title: f"```{kind}\n{text}\n```" for title, (kind, text) in blocks.items()}


@command("train")
def main(cfg: DictConfig) -> float:
    """One job; in a sweep its failure is noted, and the rest go on."""
    return do_job(cfg, work)
