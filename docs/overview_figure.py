"""Draw the picture of the README and of the first page from simulated boats; needs the extra plot.

`docs/overview.png` has three panels beside each other; in `docs/overview_narrow.png`, for telephones, they are stacked.

python docs/overview_figure.py
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import usvlearn
from usvlearn.display.figures import INK, SIDES, colours, themed
from usvlearn.estimators.ensemble.monitors.layer import effectiveness
from usvlearn.simulate.truth import quantities_of

SEASON = {
    "n": 1, "plant": "heron", "hours": 3.0, "mission_minutes": 10.0, "missions": ["patrol"], "seed": 4,
    "aborted_share": 0.0, "paused_share": 0.0,
}  # fmt: skip
MASS = 28.0  # kg, of the Heron in `configs/data/simulated.yaml`
START, BEFORE, AHEAD = 432.0, 20.0, 30.0  # s in the last run: of the forecast, shown before it, and its length
FAULT, SHARE = 10.0, 0.4  # min from which the left thruster has that share of its thrust
OURS = colours(["ensemble"])["ensemble"]
FOLDER = Path(__file__).parent
NARROW = (3.9, 8.4)  # inches of 100 px: the width of a telephone, at which 9 pt are 12.5 px


def steps(boat: usvlearn.Online, logs, which: slice = slice(None)) -> Iterator[tuple[float, usvlearn.Sample, float]]:
    """Step through runs as on a boat; after each step the time in its run, s, its sample, and the prediction, m/s."""
    for run in logs.runs[which]:
        columns = zip(run.time, *run.samples.inputs, *run.samples[1:], strict=True)
        for time, left, right, heading, yaw_rate, dt, surge, fresh, measured in columns:
            inputs = usvlearn.Inputs(*map(float, (left, right, heading, yaw_rate, dt)))
            sample = usvlearn.Sample(inputs, float(surge), bool(fresh), bool(measured))
            yield float(time - run.time[0]), sample, boat.step(sample)


def predicts(panel, ensemble: usvlearn.Ensemble, logs) -> None:
    """Measured speed, prediction one step ahead, and a forecast from one moment on under the commands of the log."""
    boat, ahead = usvlearn.Online(ensemble), None
    for _ in steps(boat, logs, slice(-1)):
        pass
    inputs = logs.runs[-1].samples.inputs
    shown = []
    for time, sample, surge in steps(boat, logs, slice(-1, None)):
        if START - BEFORE <= time <= START + AHEAD:
            shown.append((time - START, sample.surge if sample.measured else np.nan, surge))
        if time >= START and ahead is None:
            k = int(np.searchsorted(logs.runs[-1].time - logs.runs[-1].time[0], START)) + 1
            plan = slice(k, k + round(AHEAD / 0.4))
            commands = np.stack([inputs.command_left[plan], inputs.command_right[plan]], axis=-1)
            ahead = boat.forecast(commands, inputs.heading[plan], inputs.yaw_rate[plan])
    time, measured, surge = np.array(shown).T
    assert ahead is not None
    panel.fill_between(ahead.time, ahead.low, ahead.high, color=OURS, alpha=0.2, linewidth=0)
    panel.plot(ahead.time, ahead.surge, color=OURS, linewidth=1.6, label="forecast, 90 %")
    panel.plot(time, surge, color=INK, linewidth=0.9, label="one step ahead")
    panel.plot(time, measured, ".", color=INK, markersize=2.5, label="measured")
    panel.axvline(0, color=INK, linewidth=0.8, linestyle=":")
    panel.set(title="It predicts", xlabel="time from the forecast, s", ylabel="surge, m/s")


def identifies(panel, ensemble: usvlearn.Ensemble, logs) -> None:
    """The steady speed at half command with its interval, over the minutes of learning, and the true one."""
    boat, points, minute = usvlearn.Online(ensemble), [], 0.0
    for number, (_, sample, _) in enumerate(steps(boat, logs)):
        minute += sample.inputs.dt / 60
        if number % 150 == 149:
            steady = boat.identified()["steady_speed_half"]
            points.append((minute, steady.value, steady.low, steady.high))
    minutes, value, low, high = np.array(points).T
    source = {"_target_": "usvlearn.simulate.fleet.fleet"} | SEASON
    truth = quantities_of([source], MASS)["heron"]["steady_speed_half"]
    panel.fill_between(minutes, low, high, color=OURS, alpha=0.2, linewidth=0)
    panel.plot(minutes, value, color=OURS, linewidth=1.6, label="identified, 90 %")
    panel.axhline(truth, color=INK, linewidth=1, linestyle="--", label="true, at the end")
    panel.set(title="It identifies", xlabel="learned, min", ylabel="steady speed at half command, m/s")
    panel.set(xlim=(0, minutes[-1]), ylim=(truth - 0.6, truth + 0.6))


def warns(panel, ensemble: usvlearn.Ensemble) -> None:
    """The share of its thrust that each thruster has left, by the monitor, while one fails."""
    fault = {"_target_": "usvlearn.simulate.fault.Fault", "side": "left", "share": SHARE, "minute": FAULT}
    mission = {"hours": 25 / 60, "mission_minutes": 25.0, "missions": ["lawn_mower"], "fault": fault}
    logs = usvlearn.read(data="simulated", **SEASON | {"seed": 0} | mission)
    boat, shares, alarm = usvlearn.Online(ensemble), [], None
    for time, _, _ in steps(boat, logs):
        thrusters = boat.state.monitors.thrusters
        shares.append((time / 60, *effectiveness(thrusters)[0].tolist()))
        if alarm is None and thrusters.alarms > 0:
            alarm = time / 60
    minutes, *sides = np.array(shares).T
    for (side, colour), share in zip(SIDES.items(), sides, strict=True):
        panel.plot(minutes, share, color=colour, linewidth=1.4, label=side)
    panel.axvline(FAULT, color=INK, linewidth=1, linestyle="--", label="fault")
    assert alarm is not None, "the monitor has raised no alarm"
    panel.axvline(alarm, color=OURS, linewidth=1.4, label=f"alarm, {60 * (alarm - FAULT):.0f} s after")
    panel.set(title="It warns", xlabel="time, min", ylabel="share of the thrust", xlim=(8, 14), ylim=(0, 1.15))


def stack(figure, size: tuple[float, float]) -> None:
    """Put the panels of a figure below each other, in that size, with legends as large as the other text."""
    figure.set_size_inches(size)
    legends = ("lower left", "lower right", (0.48, 0.45))
    for panel, place, legend in zip(figure.axes, figure.add_gridspec(len(figure.axes), 1), legends, strict=True):
        panel.set_subplotspec(place)
        panel.legend(fontsize=9, loc=legend, handlelength=1.2)


def main() -> None:
    logs = usvlearn.read(data="simulated", **SEASON)
    ensemble = usvlearn.learn(usvlearn.read(data="simulated", hours=0.05)).ensemble  # the default one, and no more
    with themed() as Figure:
        figure = Figure(figsize=(11, 3.1), dpi=100, layout="constrained", facecolor="white")
        first, second, third = figure.subplots(1, 3, width_ratios=(1.3, 1, 1))
        predicts(first, ensemble, logs)
        identifies(second, ensemble, logs)
        warns(third, ensemble)
        for panel in (first, second, third):
            panel.grid(alpha=0.25)
            panel.legend(fontsize=7.5, loc="best")
        figure.savefig(FOLDER / "overview.png", metadata={"Software": None})
        stack(figure, NARROW)
        figure.savefig(FOLDER / "overview_narrow.png", dpi=200, metadata={"Software": None})


if __name__ == "__main__":
    main()
