"""The engine that is judged."""

import pytest
from reference_step.under_test import Engine, ENGINES


@pytest.fixture(scope="session", params=ENGINES, ids=lambda engine: engine.name)
def engine(request: pytest.FixtureRequest) -> Engine:
    return request.param
