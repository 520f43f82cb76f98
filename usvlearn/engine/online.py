"""Online: an estimator together with the state of one vehicle, or of a batch, for use in a program.

torch is not imported: `Online.open` continues from a checkpoint with compiled code alone, on a small computer.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.core.forecasts import Forecast, Track, plan_inputs
from usvlearn.core.samples import Inputs, PlanarSample, Sample, html_table, named_leaves
from usvlearn.engine import summary
from usvlearn.errors import ConfigError

if TYPE_CHECKING:
    from usvlearn.core.protocol import Estimator
    from usvlearn.engine.torch_steps import TorchStepper
    from usvlearn.estimators.joint.periodic_estimates import Identified
    from usvlearn.estimators.planar.layer import Planar


class Online:
    """Keeps a state and learns one sample at a time, without gradients.

    Args:
        estimator: any `Estimator`, or a `Planar`, which runs in compiled code alone; its hyperparameters are read now,
            so later changes have no effect.
        batch: shape of the batch, a count for each axis; `()` for one vehicle.
        backend: "kernel", "torch", or "auto", as of `rollout`.

    Attributes:
        state: a copy of the estimator's state; it can be set. After `open` it is a dict of arrays by dotted name.
        names: of the predictions in the state's leaf `predictions`, where the estimator is an ensemble.
        description: how the estimator is built, a dict (`Estimator.description`); None if it has no compiled code.
        setup: how messages become samples (`usvlearn.logs.setup.Setup.json`), which `save` writes; None if unknown.

    Raises:
        ConfigError: `backend="kernel"` for an estimator that has none.

    >>> from usvlearn import AID
    >>> online = Online(AID(mass=28.0))
    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
    >>> for speed in (0.1, 0.2, 0.3):
    ...     predicted = online.step(Sample(inputs, surge=speed, fresh=True, measured=True))
    >>> 0.2 < online.predict(inputs) < 0.5
    True
    """

    description: dict[str, Any] | None
    _template: TorchStepper | None
    _last: summary.Last = None

    def __init__(self, estimator: Estimator | Planar, batch: Sequence[int] = (), backend: str = "auto"):
        from usvlearn.core.protocol import Estimator, spec_of
        from usvlearn.engine.external import both, live
        from usvlearn.engine.torch_steps import TorchStepper

        self._name, self._template = type(estimator).__name__, None
        self.setup: Mapping[str, Any] | None = None
        self._live: Any
        if isinstance(estimator, Estimator):
            stepper = self._template = TorchStepper(estimator, batch)  # torch's steps, and the shape of the state
            self.description = spec_of(estimator)
            self._live = live(estimator, stepper.state, backend) or stepper
        else:
            self.description = estimator.description()
            self._live = both(self.description, estimator, estimator.init(batch))

    @classmethod
    def open(cls, path: str | Path, members: Mapping[str, Estimator] | None = None) -> Online:
        """Continue from a checkpoint with compiled code, without torch.

        Args:
            path: a checkpoint; or a folder of them, or the run's folder if it has one boat: the newest readable one.
            members: by name those that other code than this package steps; without, they predict nothing.

        Returns:
            The estimator, with the state of the checkpoint.

        Raises:
            CheckpointError: it cannot be read, or its description of the estimator is missing or not legal.

        >>> from tempfile import TemporaryDirectory
        >>> from usvlearn import AID
        >>> with TemporaryDirectory() as folder:
        ...     Online.open(Online(AID(mass=28.0)).save(f"{folder}/aid.safetensors")).description["kind"]
        'aid'
        """
        from usvlearn.engine.parts import external_in
        from usvlearn.engine.validate import read_checkpoint

        where = Path(path)
        leaves, facts = checkpoint.newest(where, read_checkpoint) if where.is_dir() else read_checkpoint(where)
        if missing := [name for name in external_in(facts["kernel"]) if name not in (members or {})]:
            warnings.warn(f"{path}: {', '.join(missing)} predicts nothing, unless members={{…}} has it", stacklevel=2)
        return cls.of(leaves, facts, members)

    @classmethod
    def of(
        cls, leaves: Mapping[str, np.ndarray], facts: Mapping[str, Any], members: Mapping[str, Estimator] | None = None
    ) -> Online:
        """Continue, without torch, from what `read_checkpoint` has read.

        Args:
            leaves: of the state, arrays `(*batch, …)` by dotted name.
            facts: metadata: "estimator", its name; "kernel", its description; perhaps "setup".
            members: as of `open`.

        Returns:
            The estimator, with this state.

        >>> from usvlearn import Persistence
        >>> facts = {"estimator": "Persistence", "kernel": Persistence().description()}
        >>> online = Online.of({"surge": np.array(1.5)}, facts)
        >>> online.predict(Inputs(0.0, 0.0, 0.0, 0.0, 0.4))
        1.5
        """
        from usvlearn.engine.single_steps import live_of

        self = cls.__new__(cls)
        self._template, self._name, self.description = None, facts["estimator"], facts["kernel"]
        self._live = live_of(facts["kernel"], leaves)
        self._live.current = False  # it may have been saved long ago
        if members:
            from usvlearn.engine.external import with_members

            self._live = with_members(self._live, facts["kernel"], members)
        self.setup = facts.get("setup")
        return self

    def __copy__(self) -> Online:  # a shallow copy would let two boats learn into one state
        return copy.deepcopy(self)

    @property
    def state(self) -> Any:
        """A copy of the estimator's state; after `open` a dict of arrays by dotted name. It can be set."""
        leaves = self._live.leaves
        return leaves if self._template is None else self._template.tree(leaves)

    @state.setter
    def state(self, state: Any) -> None:
        self._live.leaves = {name: checkpoint.as_array(leaf) for name, leaf in named_leaves(state)}

    @property
    def names(self) -> tuple[str, ...]:
        """Of the predictions in the state's leaf `predictions`, where the estimator is an ensemble; else ()."""
        if self._template is not None or self.description is None:
            return getattr(getattr(self._template, "estimator", None), "names", ())
        description = self.description.get("surge", self.description)
        return (*description.get("columns", ()), *description.get("rules", ()))

    @property
    def ended(self) -> Mapping[str, str]:
        """Of members that other code steps, and that have failed: the prefix of their leaves -> what happened."""
        return getattr(self._live, "ended", {})

    def predict(self, inputs: Inputs) -> float | np.ndarray:
        """The predicted surge at the end of a step; nothing is learned.

        Args:
            inputs: of the step; numbers, arrays or tensors, `(*batch,)`.

        Returns:
            m/s, `(*batch,)`; a number for one vehicle.
        """
        return self._live.predict(inputs)

    def step(self, sample: Sample | PlanarSample) -> float | np.ndarray:
        """Predict, then learn from one sample.

        A `Planar` takes a `PlanarSample`.

        Args:
            sample: numbers, arrays or tensors, `(*batch,)`.

        Returns:
            The predicted surge, m/s, `(*batch,)`; a number for one vehicle; NaN where no step was made.

        Raises:
            TypeError: a field is no number, or `fresh` or `measured` is neither a bool nor an integer; the state
                is unchanged.
            ShapeError: a field is neither one number nor of the batch's shape; the state is unchanged.
        """
        predicted = self._live.step(sample)
        self._last = sample, predicted
        return predicted

    @property
    def why(self) -> str | list[str]:
        """Why the last step returned NaN, in words; "" if it returned a number. Of a batch a list.

        >>> from usvlearn import AID, Online
        >>> boat = Online(AID(mass=28.0))
        >>> inputs = Inputs(command_left=float("nan"), command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
        >>> boat.step(Sample(inputs, surge=1.2, fresh=True, measured=True)), boat.why
        (nan, 'command_left is nan, expected -100 to 100')
        """
        return summary.why(self._last)

    def __repr__(self) -> str:
        return f"Online({'; '.join(map(': '.join, self._facts()))})"

    def _repr_html_(self) -> str:
        widths = self.last_predictions() if self.names and self._last is not None and not self._live.batch else {}
        return html_table([*self._facts(), *summary.intervals(widths)])

    def _facts(self) -> list[tuple[str, str]]:
        return summary.facts(self._name, self.names, self._live.batch, self._last)

    def leaf(self, name: str) -> np.ndarray:
        """A copy of one leaf of the state.

        Args:
            name: dotted, such as "members.aid.theta".

        Returns:
            `(*batch, …)`.

        Raises:
            KeyError: there is no such leaf.

        >>> from usvlearn import AID
        >>> Online(AID(mass=28.0), batch=(8,)).leaf("theta").shape
        (8, 9)
        """
        return self._live.leaf(name)

    def last_predictions(self) -> dict[str, tuple[float | np.ndarray, float | np.ndarray]]:
        """What each member and combiner of an ensemble predicted in the last step, and the half-width of its 90 %
        interval.

        Returns:
            Name -> the prediction, NaN where a member made none, and the half-width, infinite before ten measurements;
            m/s.

        Raises:
            ConfigError: the estimator is no ensemble.

        >>> from usvlearn import AID, Ensemble, Online
        >>> list(Online(Ensemble({"aid": AID(mass=28.0)})).last_predictions())
        ['aid', 'average']
        """
        self._need_names("last_predictions")
        return self._by_name(self._live.last_predictions())

    def predict_members(self, inputs: Inputs) -> dict[str, tuple[float | np.ndarray, float | np.ndarray]]:
        """What each member and combiner of an ensemble would predict of a step; nothing is learned.

        Args:
            inputs: of the step; numbers, arrays or tensors, `(*batch,)`.

        Returns:
            Name -> the prediction and the half-width of its 90 % interval, m/s, as of `last_predictions`.

        Raises:
            ConfigError: the estimator is no ensemble.

        >>> from usvlearn import AID, Ensemble, Online
        >>> online = Online(Ensemble({"aid": AID(mass=28.0)}))
        >>> surge, halfwidth = online.predict_members(Inputs(0.5, 0.5, 0.0, 0.0, 0.4))["aid"]
        """
        self._need_names("predict_members")
        return self._by_name(self._live.predict_members(inputs))

    def _need_names(self, name: str) -> None:
        if not self.names:
            raise ConfigError(f"{name}: found the estimator {self._name}, expected an ensemble: use step and predict")

    def _by_name(self, pair: tuple[np.ndarray, np.ndarray]) -> dict[str, tuple[float | np.ndarray, float | np.ndarray]]:
        surge, width = (np.moveaxis(each, -1, 0) for each in pair)
        values = zip(surge.tolist(), width.tolist(), strict=True) if surge.ndim == 1 else zip(surge, width, strict=True)
        return dict(zip(self.names, values, strict=True))

    @overload
    def forecast(self, commands: Any, headings: None = None, yaw_rates: None = None, dt: float = 0.4) -> Track: ...

    @overload
    def forecast(self, commands: Any, headings: Any, yaw_rates: Any = None, dt: float = 0.4) -> Forecast: ...

    def forecast(self, commands: Any, headings: Any = None, yaw_rates: Any = None, dt: float = 0.4) -> Forecast | Track:
        """The speeds of the next steps under a plan, with intervals; nothing is learned, and the state stays.

        Without headings, a `Planar` forecasts them, too: a `Track` says where the boat will be.

        Args:
            commands: shares of full scale, −1 … 1, of left and right, `(time, 2)`, or `(time, *batch, 2)`.
            headings: rad, at the beginning of each step: one number, `(time,)`, or `(time, *batch)`; None: a track.
            yaw_rates: rad/s, likewise; those of the headings by default.
            dt: length of a step, s.

        Returns:
            The speeds with their intervals; without headings the track with its ellipses.

        Raises:
            ConfigError: a number is outside its legal range, or the estimator makes no forecasts.
            ShapeError: the arrays do not fit each other.

        >>> from usvlearn import AID, Ensemble, ForecastSettings, Online
        >>> online = Online(Ensemble({"aid": AID(mass=28.0)}, forecasts=ForecastSettings()))
        >>> ahead = online.forecast([[0.5, 0.5]] * 75, headings=0.0)
        >>> ahead.surge.shape, float(ahead.high[-1])  # no interval before the first measurements
        ((75,), inf)
        """
        if headings is None:
            if not hasattr(self._live, "track"):
                raise ConfigError(
                    f"headings: found none, and {self._name}, which forecasts speeds alone; expected headings, or "
                    "Online(Planar(…)), which forecasts where the boat will be"
                )
            return self._live.track(commands, dt)
        inputs = plan_inputs(commands, headings, yaw_rates, dt, self._live.batch)
        surge, width = self._live.forecast(inputs)
        time = float(dt) * np.arange(1, len(surge) + 1)
        return Forecast(time, surge, surge - width, surge + width)

    def identified(self) -> Identified | list[Identified]:
        """Physical quantities with 90 % intervals.

        Returns:
            Of one vehicle; of a batch a list, one entry for each boat.

        Raises:
            ConfigError: no member is a joint EKF with `estimate_every`.

        >>> from usvlearn import JointEKF
        >>> Online(JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)).identified()["steady_speed_full"].unit
        'm/s'
        """
        from usvlearn.engine.identified import identified

        batch, description = self._live.batch, self.description
        leaves = {name: leaf.reshape(-1, *leaf.shape[len(batch) :]) for name, leaf in self._live.leaves.items()}
        if description is None:  # an ensemble that runs in torch; its averaged joint EKF alone is described
            from usvlearn.core.protocol import spec_of

            ensemble: Any = getattr(self._template, "estimator", None)
            name = getattr(ensemble, "averaged", None)
            members = {} if name is None else {name: spec_of(ensemble.members[name])}
            description = {"kind": "ensemble", "members": members}
        quantities = identified(description, leaves)
        return quantities if batch else quantities[0]

    def take_fit(self, table: Sequence[float]) -> None:
        """Let a batch fit forecast, too, in place of an earlier one. An ensemble without a joint EKF stays as it is.

        Args:
            table: of the fit, SI units, from `usvlearn.model.fit.hand_over.table_of`; zeros: none.

        >>> import tempfile
        >>> from usvlearn import Ensemble, Persistence
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Online(Ensemble({"still": Persistence()})).save(f"{folder}/still.safetensors")
        ...     Online.open(path).take_fit([0.0] * 151)
        """
        from usvlearn.engine.fit_member import with_fit

        assert self._template is None and self.description is not None, "expected what `open` has made"
        leaves, description = with_fit(self._live.leaves, self.description, table)
        self._live, self.description = self._live.described(description, leaves), dict(description)

    def save(self, path: str | Path, **metadata: Any) -> Path:
        """Save the state, the description of the estimator and the setup; see `usvlearn.core.checkpoint.save`.

        Args:
            path: of the file; missing folders are made.
            **metadata: further facts, as JSON stores them.

        Returns:
            The path.

        >>> from tempfile import TemporaryDirectory
        >>> from usvlearn import Persistence
        >>> with TemporaryDirectory() as folder:
        ...     path = Online(Persistence()).save(f"{folder}/boat.safetensors", boat="heron")
        ...     Online(Persistence()).restore(path)["boat"]
        'heron'
        """
        about = {"estimator": self._name, "kernel": self.description}
        facts = about | ({} if self.setup is None else {"setup": self.setup}) | metadata
        return checkpoint.save(path, self.state, **facts)

    def restore(self, path: str | Path) -> dict[str, Any]:
        """Continue from a saved state.

        Args:
            path: of the file; the newest readable one if it is a folder.

        Returns:
            The file's metadata.

        Raises:
            CheckpointError: it cannot be read, or belongs to another estimator.
        """
        from usvlearn.engine.validate import restored

        self.state, metadata = restored(Path(path), self.state, self._name, self.description)
        self.setup = metadata.get("setup", self.setup)
        return metadata
