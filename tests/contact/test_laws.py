"""Parameters of contact laws."""

import numpy as np
import pytest

import dano


@pytest.mark.parametrize("name", dano.ContactParams.__dataclass_fields__)
@pytest.mark.parametrize("value", [-0.2, np.nan, np.inf])
def test_parameters_must_be_finite_and_not_negative(name, value):
    with pytest.raises(ValueError, match=name):
        dano.ContactParams(**{name: value})
