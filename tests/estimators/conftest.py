"""What tests of estimators share: they take no gradients."""

import pytest
import torch


@pytest.fixture
def no_gradients():
    with torch.no_grad():
        yield
