"""Types of fields that a library writes in another way are read alike."""

from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from mkpc_kaggle.engine.store.json_values import json_reader_of, without_alias

Number = TypeVar("Number", bound=np.generic)
# As NumPy 2.5 declares NDArray
Array = TypeAliasType("Array", np.ndarray[Any, np.dtype[Number]], type_params=(Number,))
Name = TypeAliasType("Name", str)


@pytest.mark.parametrize("kind", [NDArray[np.float64], Array[np.float64]])
@pytest.mark.parametrize("is_optional", [False, True])
def test_an_alias_of_an_array_is_an_array(kind, is_optional):
    read = json_reader_of(kind | None if is_optional else kind)
    np.testing.assert_array_equal(read([[1, 2]]), np.array([[1.0, 2.0]]))


def test_an_alias_without_parameters_is_its_type():
    assert without_alias(Name) is str
    assert without_alias(int) is int
    assert json_reader_of(Name) is None
