"""What tests of estimators share: no gradients are taken unless a test asks for them, so that compiled code steps."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="module")  # so that it is there before what a module makes once
def no_gradients():
    with torch.no_grad():
        yield
