"""The databases that the tests of MOOS run against: the stand-in, and a real one inside a network of its own."""

import pytest

from tests.support.moosdb import Moosdb
from tests.support.real_moosdb import RealMoosdb, why_not


@pytest.fixture(params=["stand_in", "real"])
def database(request):
    """A database that is not yet started."""
    if request.param == "stand_in":
        return Moosdb()
    if reason := why_not():
        pytest.skip(reason)
    return RealMoosdb()
