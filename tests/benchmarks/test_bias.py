"""The causes of the bias of least squares: the step and the current, and hardly the sensors."""

import numpy as np
import pytest
from bias import MODELS, SEASONS, wrong
from truths import boats


@pytest.fixture(scope="module")
def drag():
    """The error of the drag by season and model, median over three boats."""
    fleets = {season: boats("heron", 3, hours=1.0, later=0.0, **options) for season, options in SEASONS.items()}
    return {
        season: {model: np.median([wrong(boat, **options).drag for boat in fleet]) for model, options in MODELS.items()}
        for season, fleet in fleets.items()
    }


@pytest.mark.thorough
def test_the_bias_is_there_with_exact_sensors(drag):
    plain = {season: models["nine parameters, Euler's step"] for season, models in drag.items()}
    assert plain["as simulated"] < -0.2 and plain["exact sensors"] < -0.2
    assert plain["no current, exact sensors"] < -0.1


@pytest.mark.thorough
def test_the_step_and_the_current_are_its_causes(drag):
    euler, both = "nine parameters, Euler's step", "both"
    assert all(abs(models[both]) < abs(models[euler]) for models in drag.values())
    assert abs(drag["no current"][both]) < 0.12
