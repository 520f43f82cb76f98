"""Surge, sway and yaw rate side by side: three ensembles whose states compiled code steps together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import nn

from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import named_leaves
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.arx.layer import ARX
from usvlearn.estimators.axis.layer import SwayEKF, YawEKF
from usvlearn.estimators.baselines.persistence.layer import Persistence
from usvlearn.estimators.ensemble.combiners.layer import BOA
from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings
from usvlearn.estimators.ensemble.forecasts.state import EMPTY, FIRST
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.manoeuvre_intervals import layer as conditional
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.planar import state as at
from usvlearn.estimators.planar.state import AXES, DUE, LIMIT, TrackState

if TYPE_CHECKING:
    from usvlearn.core.protocol import Estimator


class PlanarState(NamedTuple):
    """The state of a boat in the plane."""

    surge: EnsembleState
    sway: EnsembleState
    yaw: EnsembleState
    track: TrackState


class Planar(nn.Module):
    """The ensembles of surge, sway and yaw rate, and the tracks that they make; see `state`.

    The tracks are derived in `docs/theory/ensemble.md`, the filters of yaw rate and sway in
    `docs/theory/identification.md`.

    Args:
        surge: of the surge, with forecasts and a joint EKF among its members; its steps are those that it makes alone.
        yaw: of the yaw rate, with forecasts and a `YawEKF`; by default that and an `ARX`.
        sway: of the sway, with forecasts and a `SwayEKF`; by default that, an `ARX` and persistence.
        surge_max: top speed, m/s, of the defaults.
        horizons: s, increasing, at which the ellipses of tracks are learned.
        overlap: number of tracks to a horizon that are under way at the same time.

    Raises:
        ConfigError: an ensemble makes no forecasts, has no compiled code, or lacks its filter.

    >>> from usvlearn import Ensemble, ForecastSettings, JointEKF
    >>> surge = Ensemble({"joint": JointEKF(surge_max=2.7)}, forecasts=ForecastSettings())
    >>> Planar(surge, surge_max=2.7).init((8,)).track.covariance.shape
    torch.Size([8, 4, 3])
    """

    def __init__(
        self,
        surge: Ensemble,
        yaw: Ensemble | None = None,
        sway: Ensemble | None = None,
        surge_max: float = 3.0,
        horizons: Sequence[float] = at.HORIZONS,
        overlap: float = at.OVERLAP,
    ):
        super().__init__()
        top = check_positive("surge_max", surge_max, "of m/s")
        self.surge = surge
        arx = ARX(lags=2, even=False, turning=True, surge_max=LIMIT)
        fast = ARX(lags=2, even=False, turning=True, thrust_speed=True, surge_max=LIMIT)
        members = {"sway": SwayEKF(surge_max=top), "arx": arx, "persistence": Persistence()}
        self.sway = axis_ensemble(members) if sway is None else sway
        self.yaw = axis_ensemble({"yaw": YawEKF(surge_max=top), "arx": fast}) if yaw is None else yaw
        if not isinstance(horizons, Sequence) or isinstance(horizons, str):
            raise ConfigError(f"horizons: found {horizons!r}, expected a list of times, s")
        self.horizons = tuple(check_positive("horizons", h, "of s") for h in horizons)
        if not self.horizons or sorted(set(self.horizons)) != list(self.horizons):
            raise ConfigError(f"horizons: found {list(horizons)}, expected times, s, increasing")
        self.overlap = check_positive("overlap", overlap)
        if overlap > at.MOST_OVERLAP:
            raise ConfigError(f"overlap: found {overlap!r}, expected at most {at.MOST_OVERLAP:g}")

    def init(self, batch: Sequence[int] = ()) -> PlanarState:
        """The state before the first sample, leaves `(*batch, …)`.

        Args:
            batch: shape of the batch, a count for each axis.

        Returns:
            The state, leaves `(*batch, …)`.
        """
        batch, H = tuple(batch), len(self.horizons)
        axes = {axis: getattr(self, axis).init(batch) for axis in AXES}
        blocks = (  # each member's weights, and what an open-loop simulation needs of it, of the first slot
            leaf[(0,) * (len(batch) + 1)].numel()
            for state in axes.values()
            for leaf in [state.forecasts.weights, *(leaf for _, leaf in named_leaves(state.forecasts.frozen))]
        )
        slots, length = at.slots_of(self.horizons, self.overlap), at.slot_length(H, blocks)
        like = axes["surge"].predictions
        under_way = like.new_zeros((*batch, slots, length))
        under_way[..., at.ELAPSED] = EMPTY
        track = TrackState(
            slots=under_way,
            since=torch.tensor(self.horizons, dtype=like.dtype).expand(*batch, H).clone(),
            before=like.new_zeros((*batch, 6)),
            surprise=like.new_ones((*batch, 4)),
            covariance=like.new_zeros((*batch, H, 3)),
            error=like.new_zeros((*batch, H)),
            quantile=like.new_full((*batch, H), FIRST),
            errors=like.new_zeros((*batch, H)),
            learned=conditional.init(batch, H, like[..., 0]),
            due=like.new_full((*batch, H, DUE), math.nan),
        )
        return PlanarState(**axes, track=track)

    def description(self) -> dict[str, Any]:
        """The description by which the engine makes the steps.

        Returns:
            The descriptions of the three ensembles, and the numbers of the tracks, as JSON stores them.

        Raises:
            ConfigError: an ensemble makes no forecasts, has no compiled code, or lacks its filter.

        >>> from usvlearn import Ensemble, ForecastSettings, JointEKF
        >>> surge = Ensemble({"joint": JointEKF(surge_max=2.7)}, forecasts=ForecastSettings())
        >>> Planar(surge, surge_max=2.7).description()["kind"]
        'planar'
        """
        described: dict[str, Any] = {"kind": "planar"}
        for axis in AXES:
            ensemble = spec_of(getattr(self, axis))
            if ensemble is None or not ensemble.get("forecasts"):
                raise ConfigError(
                    f"{axis}: found an ensemble without compiled code or forecasts, expected both: set forecasts"
                )
            if at.filter_of(axis, ensemble) is None:
                raise ConfigError(
                    f"{axis}: found the members {', '.join(ensemble['members'])}, expected a filter of the kind "
                    f"{at.FILTERS[axis]} among them"
                )
            described[axis] = ensemble
        numbers = {"coverage": self.surge.coverage, "overlap": self.overlap}
        return described | {"numbers": numbers, "vectors": {"horizons": list(self.horizons)}}


def axis_ensemble(members: dict[str, Estimator]) -> Ensemble:
    """An ensemble of a sway or a yaw rate. The default members were chosen on the first halves of recorded logs."""
    forecasts = ForecastSettings(members=list(members))
    return Ensemble(members, {"ensemble": BOA()}, surge_max=LIMIT, watched=False, forecasts=forecasts)
