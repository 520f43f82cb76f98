"""What tests of estimators share: no gradients are taken unless a test asks for them, so that compiled code steps."""

import pytest
import torch


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield
